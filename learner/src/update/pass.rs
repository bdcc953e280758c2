//! The backward pass of a network over one block of rows, for the gradients that are wanted and no
//! others.

use dmprl_shared::policy::{Activations, MlpShape};

use super::kernels::{Backward, NormaliseBackward};
use super::layer_norm::{LayerNorm, Normalised};
use super::packed::Packed;

/// The gradient with respect to every layer's output, for up to `rows_max` rows.
#[derive(Debug)]
pub struct Gradients {
    layers: Vec<Vec<f32>>,
    /// Of layers with normalisation, with respect to what comes after it.
    normalised: Vec<Vec<f32>>,
}

impl Gradients {
    /// Buffers for up to `rows_max` rows.
    #[must_use]
    pub fn new(shape: &MlpShape, rows_max: usize) -> Self {
        let layers = shape.layers().iter().map(|l| vec![0.0; rows_max * l.outputs]);
        Self { layers: layers.collect(), normalised: Vec::new() }
    }

    /// The same for a network with layer normalisation.
    #[must_use]
    pub fn with_layer_norm(shape: &MlpShape, rows_max: usize) -> Self {
        let Self { layers, .. } = Self::new(shape, rows_max);
        let normalised = layers[..layers.len() - 1].to_vec();
        Self { layers, normalised }
    }

    /// Where the gradient with respect to the network's output, (rows, outputs), goes before
    /// [`Pass::backward`] is called.
    pub fn output_mut(&mut self, shape: &MlpShape, rows: usize) -> &mut [f32] {
        let last = self.layers.len() - 1;
        &mut self.layers[last][..rows * shape.outputs()]
    }

    /// With respect to the sums of layer `index`, before normalisation and activation, (rows,
    /// outputs).
    #[must_use]
    pub fn layer(&self, shape: &MlpShape, index: usize, rows: usize) -> &[f32] {
        &self.layers[index][..rows * shape.layers()[index].outputs]
    }

    /// With respect to layer `index` after normalisation, gain and shift and before its activation,
    /// (rows, outputs).
    #[must_use]
    pub fn normalised_layer(&self, shape: &MlpShape, index: usize, rows: usize) -> &[f32] {
        &self.normalised[index][..rows * shape.layers()[index].outputs]
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
    /// The normalisation of its hidden layers, if any, and what it left.
    pub normalised: Option<(&'a LayerNorm, &'a Normalised)>,
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

    /// Turns the gradient at the sums of layer `index` into the one at the sums of the layer
    /// before: masked by its ReLU, then through its normalisation.
    fn step_back(self, gradients: &mut Gradients, index: usize) {
        let rows = self.rows;
        let layer = &self.shape.layers()[index];
        let (before, at) = gradients.layers.split_at_mut(index);
        let sums_gradient = &mut before[index - 1][..rows * layer.inputs];
        let normalisation = self.normalised.and_then(|(norm, normalised)| {
            Some((norm.layer(index - 1)?, normalised.layer(self.shape, index - 1, rows)))
        });
        let Some((places, [normalised, inverse_std])) = normalisation else {
            return self.product_back(index, &at[0], sums_gradient);
        };
        let gradient = &mut gradients.normalised[index - 1][..rows * layer.inputs];
        self.product_back(index, &at[0], gradient);
        let gain = &self.parameters[places.gain.clone()];
        NormaliseBackward { gradient, normalised, inverse_std, gain, sums_gradient }
            .run(self.packed.instructions());
    }

    /// From the gradient at the sums of layer `index`, in a buffer for all rows, to the one at its
    /// inputs, masked by their ReLU.
    fn product_back(self, index: usize, gradient: &[f32], inputs_gradient: &mut [f32]) {
        let rows = self.rows;
        let layer = &self.shape.layers()[index];
        let product = Backward {
            gradient: &gradient[..rows * layer.outputs],
            weights: &self.parameters[layer.weights.clone()],
            outputs_len: layer.outputs,
            first: 0,
            activations: Some(self.activations.layer(self.shape, index - 1, rows)),
            inputs_gradient,
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
