//! A network's weights in the order in which the forward pass reads them.

use std::ops::Range;

use dmprl_shared::policy::MlpShape;

use super::kernels::{InstructionSet, pack, packed_len};

/// The packed weights of all layers.
#[derive(Debug)]
pub struct Packed {
    values: Vec<f32>,
    layers: Vec<Range<usize>>,
    /// [`crate::networks::Parameters::changes`] of the parameters that this is a copy of; 0: of
    /// none yet.
    pub changes: u64,
}

impl Packed {
    /// A copy of nothing yet.
    #[must_use]
    pub fn new(shape: &MlpShape) -> Self {
        let layers: Vec<_> = (0..shape.layers().len())
            .map(|layer| Self::range(shape, layer, 0..shape.layers()[layer].outputs))
            .collect();
        let len = layers.last().map_or(0, |layer| layer.end);
        Self { values: vec![0.0; len], layers, changes: 0 }
    }

    /// Where the given outputs of a layer stand; they begin at a whole panel and end at one, or
    /// with the layer.
    #[must_use]
    pub fn range(shape: &MlpShape, layer: usize, outputs: Range<usize>) -> Range<usize> {
        let len = |layer: usize| {
            let layer = &shape.layers()[layer];
            packed_len(layer.inputs, layer.outputs)
        };
        let begin: usize = (0..layer).map(len).sum();
        let inputs = shape.layers()[layer].inputs;
        let end = if outputs.end == shape.layers()[layer].outputs {
            len(layer)
        } else {
            outputs.end * inputs
        };
        begin + outputs.start * inputs..begin + end
    }

    /// The packed weights of one layer.
    #[must_use]
    pub fn layer(&self, index: usize) -> &[f32] {
        &self.values[self.layers[index].clone()]
    }

    /// All of them, to write those of [`Packed::range`].
    pub fn values_mut(&mut self) -> &mut [f32] {
        &mut self.values
    }

    /// Takes over a network's flat parameters.
    pub fn fill(&mut self, shape: &MlpShape, parameters: &[f32], instructions: InstructionSet) {
        for (layer, range) in shape.layers().iter().zip(&self.layers) {
            let (weights, packed) =
                (&parameters[layer.weights.clone()], &mut self.values[range.clone()]);
            pack(weights, layer.inputs, layer.outputs, packed, instructions);
        }
    }
}
