//! The multilayer perceptron of policies and critics: ReLU layers and a linear last layer.

use std::ops::Range;

use rand::{Rng, RngExt};

use super::matrix::{Keep, Matrix, product};

/// Widths of a network, and the position of each layer in its flat parameters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MlpShape {
    widths: Vec<usize>,
    layers: Vec<Layer>,
}

/// One linear layer: outputs = inputs weightsᵀ + bias.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layer {
    /// Width of its input.
    pub inputs: usize,
    /// Width of its output.
    pub outputs: usize,
    /// Range of its weights in the flat parameters, (outputs, inputs) row-major.
    pub weights: Range<usize>,
    /// Range of its bias in the flat parameters, (outputs,).
    pub bias: Range<usize>,
}

impl MlpShape {
    /// Creates a network of the given widths, input first, output last.
    ///
    /// # Panics
    /// If there are fewer than two widths.
    #[must_use]
    pub fn new(widths: Vec<usize>) -> Self {
        assert!(widths.len() >= 2, "a network has an input and an output");
        let mut at = 0;
        let layers = widths
            .windows(2)
            .map(|pair| {
                let (inputs, outputs) = (pair[0], pair[1]);
                let weights = at..at + inputs * outputs;
                let bias = weights.end..weights.end + outputs;
                at = bias.end;
                Layer { inputs, outputs, weights, bias }
            })
            .collect();
        Self { widths, layers }
    }

    /// Width of the input.
    #[must_use]
    pub fn inputs(&self) -> usize {
        self.widths[0]
    }

    /// Width of the output.
    #[must_use]
    pub fn outputs(&self) -> usize {
        self.widths[self.widths.len() - 1]
    }

    /// The layers, first to last.
    #[must_use]
    pub fn layers(&self) -> &[Layer] {
        &self.layers
    }

    /// Length of the flat parameters.
    #[must_use]
    pub fn parameters_len(&self) -> usize {
        self.layers.last().map_or(0, |layer| layer.bias.end)
    }
}

/// Draws weights and biases from U(-1/sqrt(inputs), 1/sqrt(inputs)).
///
/// This is PyTorch's default for linear layers, so results are comparable with the baselines.
pub fn initial_parameters(shape: &MlpShape, random: &mut impl Rng) -> Vec<f32> {
    let mut parameters = Vec::with_capacity(shape.parameters_len());
    for layer in shape.layers() {
        let bound = 1.0 / (layer.inputs as f32).sqrt();
        let count = layer.weights.len() + layer.bias.len();
        parameters.extend((0..count).map(|_| random.random_range(-bound..bound)));
    }
    parameters
}

/// The outputs of every layer for up to `rows_max` inputs.
#[derive(Debug)]
pub struct Activations(Vec<Vec<f32>>);

impl Activations {
    /// Allocates buffers for up to `rows_max` rows.
    #[must_use]
    pub fn new(shape: &MlpShape, rows_max: usize) -> Self {
        Self(shape.layers().iter().map(|layer| vec![0.0; rows_max * layer.outputs]).collect())
    }

    /// The network's output, (rows, outputs).
    #[must_use]
    pub fn output(&self, shape: &MlpShape, rows: usize) -> &[f32] {
        self.layer(shape, shape.layers().len() - 1, rows)
    }

    /// The network's output, (rows, outputs), mutable so that exploration can add noise.
    pub fn output_mut(&mut self, shape: &MlpShape, rows: usize) -> &mut [f32] {
        let last = self.0.len() - 1;
        &mut self.0[last][..rows * shape.outputs()]
    }

    /// The output of layer `index`, after ReLU for all but the last, (rows, outputs).
    #[must_use]
    pub fn layer(&self, shape: &MlpShape, index: usize, rows: usize) -> &[f32] {
        &self.0[index][..rows * shape.layers()[index].outputs]
    }

    /// Returns the inputs, (rows, inputs), and the output buffer, (rows, outputs), of layer
    /// `index`. For the first layer the inputs are `inputs`.
    pub fn step<'a>(
        &'a mut self,
        shape: &MlpShape,
        index: usize,
        inputs: &'a [f32],
    ) -> (&'a [f32], &'a mut [f32]) {
        let rows = inputs.len() / shape.inputs();
        let layer = &shape.layers()[index];
        let (before, after) = self.0.split_at_mut(index);
        let inputs = before.last().map_or(inputs, |buffer| &buffer[..rows * layer.inputs]);
        (inputs, &mut after[0][..rows * layer.outputs])
    }
}

/// Runs the network on `inputs`, (rows, inputs), into `activations`.
///
/// # Panics
/// If a length is wrong.
pub fn forward(
    shape: &MlpShape,
    parameters: &[f32],
    inputs: &[f32],
    activations: &mut Activations,
) {
    let weights = |layer: &Layer| {
        let weights = &parameters[layer.weights.clone()];
        Matrix::row_major(weights, layer.outputs, layer.inputs).transposed()
    };
    forward_with(shape, parameters, &weights, inputs, activations);
}

/// Runs the network with each layer's (inputs, outputs) weights from `weights`.
fn forward_with<'a>(
    shape: &MlpShape,
    parameters: &[f32],
    weights: &dyn Fn(&Layer) -> Matrix<'a>,
    inputs: &[f32],
    activations: &mut Activations,
) {
    assert_eq!(parameters.len(), shape.parameters_len(), "network parameters");
    let rows = inputs.len() / shape.inputs();
    let last = shape.layers().len() - 1;
    for (index, layer) in shape.layers().iter().enumerate() {
        let (inputs, out) = activations.step(shape, index, inputs);
        let bias = &parameters[layer.bias.clone()];
        for row in out.chunks_exact_mut(layer.outputs) {
            row.copy_from_slice(bias);
        }
        let inputs = Matrix::row_major(inputs, rows, layer.inputs);
        product(out, inputs, weights(layer), Keep::Add);
        if index < last {
            for value in out.iter_mut() {
                *value = value.max(0.0);
            }
        }
    }
}

/// A network for small batches and rarely changing parameters, as in a worker.
///
/// For small batches, reading the weights dominates the cost of a product. gemm needs them in the
/// order (inputs, outputs). From the order of the flat parameters it would rearrange them for every
/// product, which takes three times as long as the product. [`SmallBatchNetwork::load`] does it
/// once per policy. The results equal those of [`forward`] up to rounding.
#[derive(Debug, Clone)]
pub struct SmallBatchNetwork {
    shape: MlpShape,
    /// The flat parameters with the weights in the order (inputs, outputs).
    parameters: Vec<f32>,
}

impl SmallBatchNetwork {
    /// Creates a network whose parameters are zero.
    #[must_use]
    pub fn new(shape: MlpShape) -> Self {
        let parameters = vec![0.0; shape.parameters_len()];
        Self { shape, parameters }
    }

    /// Loads flat parameters.
    ///
    /// # Panics
    /// If their number does not match the shape.
    pub fn load(&mut self, parameters: &[f32]) {
        assert_eq!(parameters.len(), self.parameters.len(), "network parameters");
        for layer in self.shape.layers() {
            self.parameters[layer.bias.clone()].copy_from_slice(&parameters[layer.bias.clone()]);
            let from = &parameters[layer.weights.clone()];
            let to = &mut self.parameters[layer.weights.clone()];
            for (output, row) in from.chunks_exact(layer.inputs).enumerate() {
                for (input, weight) in row.iter().enumerate() {
                    to[input * layer.outputs + output] = *weight;
                }
            }
        }
    }

    /// Runs the network on `inputs`, (rows, inputs), into `activations`.
    ///
    /// # Panics
    /// If a length is wrong.
    pub fn forward(&self, inputs: &[f32], activations: &mut Activations) {
        let weights = |layer: &Layer| {
            let weights = &self.parameters[layer.weights.clone()];
            Matrix::row_major(weights, layer.inputs, layer.outputs)
        };
        let (shape, parameters) = (&self.shape, &self.parameters);
        forward_with(shape, parameters, &weights, inputs, activations);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forward_matches_a_value_worked_by_hand() {
        // 2 -> 2 (ReLU) -> 1. For x = (1, -1) the hidden layer is
        // relu([1*1 + 2*(-1) + 0.5, 3*1 + 1*(-1) - 4]) = relu([-0.5, -2]),
        // and relu([1 + 2 + 0.5, 3 + 1 - 4]) = [3.5, 0] for x = (1, 1).
        let shape = MlpShape::new(vec![2, 2, 1]);
        let parameters = [1.0, 2.0, 3.0, 1.0, 0.5, -4.0, 2.0, -1.0, 0.25];
        let mut activations = Activations::new(&shape, 2);
        forward(&shape, &parameters, &[1.0, -1.0, 1.0, 1.0], &mut activations);
        assert_eq!(activations.output(&shape, 2), [0.25, 7.25]);
    }

    #[test]
    fn small_batch_network_matches_forward() {
        let shape = MlpShape::new(vec![14, 256, 256, 20]);
        let mut random = crate::seeds::stream(1, "test", 0);
        let parameters = initial_parameters(&shape, &mut random);
        let mut network = SmallBatchNetwork::new(shape.clone());
        network.load(&parameters);
        for rows in [1, 8, 16, 100] {
            let inputs: Vec<f32> = (0..rows * 14).map(|i| (i as f32).sin()).collect();
            let mut expected = Activations::new(&shape, rows);
            forward(&shape, &parameters, &inputs, &mut expected);
            let mut activations = Activations::new(&shape, rows);
            network.forward(&inputs, &mut activations);
            let both = activations.output(&shape, rows).iter().zip(expected.output(&shape, rows));
            for (got, want) in both {
                assert!((got - want).abs() < 1e-6, "{rows} rows: {got} {want}");
            }
        }
    }

    #[test]
    fn initial_parameters_fill_their_bounds() {
        let shape = MlpShape::new(vec![4, 64, 3]);
        let mut random = crate::seeds::stream(1, "test", 0);
        let parameters = initial_parameters(&shape, &mut random);
        assert_eq!(parameters.len(), shape.parameters_len());
        let first = &parameters[shape.layers()[0].weights.clone()];
        let largest = first.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
        assert!(largest <= 0.5 && largest > 0.45);
    }
}
