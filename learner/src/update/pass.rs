//! The backward pass of a network over one block of rows, for the gradients that are wanted and no
//! others.

use dmprl_shared::policy::{Activations, MlpShape};

use super::kernels::Backward;
use super::packed::Packed;

/// The gradient with respect to every layer's output, for up to `rows_max` rows.
#[derive(Debug)]
pub struct Gradients {
    layers: Vec<Vec<f32>>,
}

impl Gradients {
    /// Buffers for up to `rows_max` rows.
    #[must_use]
    pub fn new(shape: &MlpShape, rows_max: usize) -> Self {
        Self { layers: shape.layers().iter().map(|l| vec![0.0; rows_max * l.outputs]).collect() }
    }

    /// Where the gradient with respect to the network's output, (rows, outputs), goes before
    /// [`Pass::backward`] is called.
    pub fn output_mut(&mut self, shape: &MlpShape, rows: usize) -> &mut [f32] {
        let last = self.layers.len() - 1;
        &mut self.layers[last][..rows * shape.outputs()]
    }

    /// With respect to the output of layer `index` before its activation, (rows, outputs).
    #[must_use]
    pub fn layer(&self, shape: &MlpShape, index: usize, rows: usize) -> &[f32] {
        &self.layers[index][..rows * shape.layers()[index].outputs]
    }
}

/// A network that has run forward over `rows` rows.
#[derive(Debug, Clone, Copy)]
pub struct Pass<'a> {
    /// The network.
    pub shape: &'a MlpShape,
    /// Its parameters, (P,).
    pub parameters: &'a [f32],
    /// What the forward pass left.
    pub activations: &'a Activations,
    /// How many.
    pub rows: usize,
    /// Its parameters as the passes read them.
    pub packed: &'a Packed,
}

impl Pass<'_> {
    /// From the gradient at the network's output to those at the outputs of all layers.
    pub fn backward(self, gradients: &mut Gradients) {
        for index in (1..self.shape.layers().len()).rev() {
            self.step_back(gradients, index);
        }
    }

    /// Turns the gradient at the output of layer `index` into the one at the output of the layer
    /// before, masked by its ReLU.
    fn step_back(self, gradients: &mut Gradients, index: usize) {
        let rows = self.rows;
        let layer = &self.shape.layers()[index];
        let (before, at) = gradients.layers.split_at_mut(index);
        let product = Backward {
            gradient: &at[0][..rows * layer.outputs],
            weights: &self.parameters[layer.weights.clone()],
            outputs_len: layer.outputs,
            first: 0,
            activations: Some(self.activations.layer(self.shape, index - 1, rows)),
            inputs_gradient: &mut before[index - 1][..rows * layer.inputs],
        };
        self.packed.backward(self.shape, index, product);
    }

    /// After [`Pass::backward`]: the gradient with respect to the inputs from column `first` on,
    /// (rows, inputs - first), overwritten.
    pub fn input_gradient(self, gradients: &Gradients, first: usize, out: &mut [f32]) {
        let layer = &self.shape.layers()[0];
        let product = Backward {
            gradient: gradients.layer(self.shape, 0, self.rows),
            weights: &self.parameters[layer.weights.clone()],
            outputs_len: layer.outputs,
            first,
            activations: None,
            inputs_gradient: out,
        };
        self.packed.backward(self.shape, 0, product);
    }
}
