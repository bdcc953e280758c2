//! The backward pass of a network over one shard. It computes only the gradients that are needed.

use dmprl_shared::policy::{Activations, MlpShape};

use super::kernels::{Backward, NormaliseBackward};
use super::layer_norm::{LayerNorm, Normalised, NormalisedRows};
use super::packed_weights::PackedWeights;

/// The gradient with respect to every layer's sums, for up to `rows_max` rows. A layer's sums are
/// its outputs before normalisation and activation.
#[derive(Debug)]
pub struct Gradients {
    layers: Vec<Vec<f32>>,
    /// With respect to the hidden layers after normalisation, if they are normalised.
    normalised: Vec<Vec<f32>>,
}

impl Gradients {
    /// Allocates buffers for up to `rows_max` rows.
    #[must_use]
    pub fn new(shape: &MlpShape, rows_max: usize) -> Self {
        let layers = shape.layers().iter().map(|l| vec![0.0; rows_max * l.outputs]);
        Self { layers: layers.collect(), normalised: Vec::new() }
    }

    /// Allocates buffers for a network with layer normalisation.
    #[must_use]
    pub fn with_layer_norm(shape: &MlpShape, rows_max: usize) -> Self {
        let Self { layers, .. } = Self::new(shape, rows_max);
        let normalised = layers[..layers.len() - 1].to_vec();
        Self { layers, normalised }
    }

    /// Returns the gradient with respect to the network's output, (rows, outputs). The caller fills
    /// it before [`BackwardPass::run`].
    pub fn output_mut(&mut self, shape: &MlpShape, rows: usize) -> &mut [f32] {
        let last = self.layers.len() - 1;
        &mut self.layers[last][..rows * shape.outputs()]
    }

    /// Returns the gradient with respect to the sums of layer `index`, (rows, outputs).
    #[must_use]
    pub fn layer(&self, shape: &MlpShape, index: usize, rows: usize) -> &[f32] {
        &self.layers[index][..rows * shape.layers()[index].outputs]
    }

    /// Returns the gradient with respect to layer `index` after normalisation, gain and shift and
    /// before its activation, (rows, outputs).
    #[must_use]
    pub fn normalised_layer(&self, shape: &MlpShape, index: usize, rows: usize) -> &[f32] {
        &self.normalised[index][..rows * shape.layers()[index].outputs]
    }
}

/// A network after its forward pass over `rows` rows.
#[derive(Debug, Clone, Copy)]
pub struct BackwardPass<'a> {
    /// The network's layers.
    pub shape: &'a MlpShape,
    /// Its parameters, (P,).
    pub parameters: &'a [f32],
    /// Outputs of all layers, from the forward pass.
    pub activations: &'a Activations,
    /// Layer normalisation of the hidden layers, if any, with the normalised values.
    pub normalised: Option<(&'a LayerNorm, &'a Normalised)>,
    /// Rows of the shard.
    pub rows: usize,
    /// Copies of the weights in the order of the passes.
    pub packed: &'a PackedWeights,
}

impl BackwardPass<'_> {
    /// Computes the gradients at all layers from the gradient at the network's output.
    pub fn run(self, gradients: &mut Gradients) {
        for index in (1..self.shape.layers().len()).rev() {
            self.step_back(gradients, index);
        }
    }

    /// Computes the gradient at the sums of layer `index - 1` from that at the sums of layer
    /// `index`: masked by the ReLU, then through the normalisation.
    fn step_back(self, gradients: &mut Gradients, index: usize) {
        let rows = self.rows;
        let layer = &self.shape.layers()[index];
        let (before, from_index) = gradients.layers.split_at_mut(index);
        let gradient = &from_index[0];
        let sums_gradient = &mut before[index - 1][..rows * layer.inputs];
        let normalisation = self.normalised.and_then(|(norm, normalised)| {
            Some((norm.layer(index - 1)?, normalised.layer(self.shape, index - 1, rows)))
        });
        let Some((gain_shift, rows_before)) = normalisation else {
            return self.product_back(index, gradient, sums_gradient);
        };
        let normalised_gradient = &mut gradients.normalised[index - 1][..rows * layer.inputs];
        self.product_back(index, gradient, normalised_gradient);
        let NormalisedRows { values: normalised, inverse_std } = rows_before;
        let gain = &self.parameters[gain_shift.gain.clone()];
        let gradient = normalised_gradient;
        NormaliseBackward { gradient, normalised, inverse_std, gain, sums_gradient }
            .run(self.packed.instructions());
    }

    /// Computes the gradient at the inputs of layer `index`, masked by their ReLU, from that at its
    /// sums. `gradient` may be longer than `rows` rows.
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
        self.packed.backward(index, product);
    }

    /// Computes the gradient with respect to the network's inputs from column `first` on, (rows,
    /// inputs - first), into `out`. Call it after [`BackwardPass::run`].
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
        self.packed.backward(0, product);
    }
}
