//! The network's backward pass, for the gradients that are wanted and no others.

use dmprl_shared::policy::{Activations, Keep, Matrix, MlpShape, Threads, product};

/// The gradient with respect to every layer's output, for up to `rows_max` rows.
#[derive(Debug)]
pub struct BackwardWorkspace {
    layers: Vec<Vec<f32>>,
}

impl BackwardWorkspace {
    /// Buffers for up to `rows_max` rows.
    #[must_use]
    pub fn new(shape: &MlpShape, rows_max: usize) -> Self {
        Self { layers: shape.layers().iter().map(|l| vec![0.0; rows_max * l.outputs]).collect() }
    }

    /// Where the gradient with respect to the network's output, (rows, outputs), goes before
    /// [`parameters_gradient`] or [`input_gradient`] is called.
    pub fn output_gradient(&mut self, shape: &MlpShape, rows: usize) -> &mut [f32] {
        let last = self.layers.len() - 1;
        &mut self.layers[last][..rows * shape.outputs()]
    }
}

/// One forward pass whose gradients are wanted.
#[derive(Debug, Clone, Copy)]
pub struct Pass<'a> {
    /// The network.
    pub shape: &'a MlpShape,
    /// Its parameters, (P,).
    pub parameters: &'a [f32],
    /// The inputs, (rows, inputs).
    pub inputs: &'a [f32],
    /// What the forward pass left.
    pub activations: &'a Activations,
    /// Threads of each product.
    pub threads: Threads,
}

impl Pass<'_> {
    fn rows(&self) -> usize {
        self.inputs.len() / self.shape.inputs()
    }

    /// Turns the gradient at the output of layer `index` into the one at the output of the layer
    /// before, masked by its ReLU.
    fn step_back(&self, work: &mut BackwardWorkspace, index: usize) {
        let rows = self.rows();
        let layer = &self.shape.layers()[index];
        let (before, at) = work.layers.split_at_mut(index);
        let out = &mut before[index - 1][..rows * layer.inputs];
        let gradient = Matrix::row_major(&at[0][..rows * layer.outputs], rows, layer.outputs);
        let weights = &self.parameters[layer.weights.clone()];
        let weights = Matrix::row_major(weights, layer.outputs, layer.inputs);
        product(out, gradient, weights, Keep::Replace, self.threads);
        let activation = self.activations.layer(self.shape, index - 1, rows);
        for (gradient, activation) in out.iter_mut().zip(activation) {
            // A select, not a branch: activations are as good as random, and a branch on them cost
            // a sixth of the update.
            *gradient = if *activation > 0.0 { *gradient } else { 0.0 };
        }
    }
}

/// Gradient with respect to the parameters, (P,), overwritten.
pub fn parameters_gradient(pass: Pass<'_>, work: &mut BackwardWorkspace, out: &mut [f32]) {
    let rows = pass.rows();
    for index in (0..pass.shape.layers().len()).rev() {
        let layer = &pass.shape.layers()[index];
        let gradient = &work.layers[index][..rows * layer.outputs];
        let inputs = match index {
            0 => pass.inputs,
            _ => pass.activations.layer(pass.shape, index - 1, rows),
        };
        let inputs = Matrix::row_major(inputs, rows, layer.inputs);
        let transposed = Matrix::row_major(gradient, rows, layer.outputs).transposed();
        product(&mut out[layer.weights.clone()], transposed, inputs, Keep::Replace, pass.threads);
        let bias = &mut out[layer.bias.clone()];
        bias.fill(0.0);
        for row in gradient.chunks_exact(layer.outputs) {
            for (bias, gradient) in bias.iter_mut().zip(row) {
                *bias += gradient;
            }
        }
        if index > 0 {
            pass.step_back(work, index);
        }
    }
}

/// Gradient with respect to the inputs from column `first` on, (rows, inputs - first),
/// overwritten; no parameter's gradient is computed.
pub fn input_gradient(pass: Pass<'_>, work: &mut BackwardWorkspace, first: usize, out: &mut [f32]) {
    let rows = pass.rows();
    for index in (1..pass.shape.layers().len()).rev() {
        pass.step_back(work, index);
    }
    let layer = &pass.shape.layers()[0];
    let gradient = Matrix::row_major(&work.layers[0][..rows * layer.outputs], rows, layer.outputs);
    let weights = &pass.parameters[layer.weights.clone()];
    let weights = Matrix::row_major(weights, layer.outputs, layer.inputs).columns_from(first);
    product(out, gradient, weights, Keep::Replace, pass.threads);
}
