//! A network's weights in the orders in which its passes read them.

use std::ops::Range;

use dmprl_shared::policy::{Layer, MlpShape};

use super::arithmetic::Arithmetic;
use super::crew::Disjoint;
use super::kernels::bf16::{Pair, forward_len, pairs};
use super::kernels::{Activation, Backward, Forward, InstructionSet, pack, packed_len};

/// Copies of all layers' weights: panels for the forward pass and, of layers whose products are of
/// 16 bits, pairs for both passes.
#[derive(Debug)]
pub struct Packed {
    arithmetic: Arithmetic,
    panels: Vec<f32>,
    forward: Vec<Pair>,
    backward: Vec<Pair>,
    layers: Vec<Places>,
    /// [`crate::networks::Parameters::changes`] of the parameters that this is a copy of; 0: of
    /// none yet.
    pub changes: u64,
}

/// Where a layer, or some outputs of it, stand in each copy.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Places {
    panels: Range<usize>,
    forward: Range<usize>,
    backward: Range<usize>,
}

/// A packed network whose layers different threads write, piece by piece.
pub struct PackedPieces<'a> {
    arithmetic: Arithmetic,
    layers: &'a [Places],
    panels: Disjoint<'a, f32>,
    forward: Disjoint<'a, Pair>,
    backward: Disjoint<'a, Pair>,
}

impl Packed {
    /// A copy of nothing yet.
    #[must_use]
    pub fn new(shape: &MlpShape, arithmetic: Arithmetic) -> Self {
        let mut ends = [0; 3];
        let mut take = |index: usize, len: usize| {
            let begin = ends[index];
            ends[index] += len;
            begin..ends[index]
        };
        let place = |layer: &Layer| {
            let (inputs, outputs) = (layer.inputs, layer.outputs);
            match arithmetic.bf16(layer) {
                None => Places {
                    panels: take(0, packed_len(inputs, outputs)),
                    forward: take(1, 0),
                    backward: take(2, 0),
                },
                Some(_) => Places {
                    panels: take(0, 0),
                    forward: take(1, forward_len(inputs, outputs)),
                    backward: take(2, pairs(outputs) * inputs),
                },
            }
        };
        let layers = shape.layers().iter().map(place).collect();
        let [panels, forward, backward] = ends;
        Self {
            arithmetic,
            panels: vec![0.0; panels],
            forward: vec![0; forward],
            backward: vec![0; backward],
            layers,
            changes: 0,
        }
    }

    /// The instructions of its passes.
    #[must_use]
    pub fn instructions(&self) -> InstructionSet {
        self.arithmetic.instructions
    }

    /// outputs = activation(inputs weightsᵀ + bias) of `layer`, which is a shape's layer `index`.
    pub fn forward(
        &self,
        (index, layer): (usize, &Layer),
        activation: Activation,
        parameters: &[f32],
        inputs: &[f32],
        outputs: &mut [f32],
    ) {
        let bias = &parameters[layer.bias.clone()];
        let places = &self.layers[index];
        match self.arithmetic.bf16(layer) {
            None => {
                let packed = &self.panels[places.panels.clone()];
                Forward { inputs, packed, bias, activation, outputs }
                    .run(self.arithmetic.instructions);
            }
            Some(bf16) => {
                let packed = &self.forward[places.forward.clone()];
                bf16.forward(inputs, packed, bias, activation, outputs);
            }
        }
    }

    /// Computes `pass`, a backward product of layer `index`.
    pub fn backward(&self, shape: &MlpShape, index: usize, pass: Backward<'_>) {
        match self.arithmetic.bf16(&shape.layers()[index]) {
            None => pass.run(self.arithmetic.instructions),
            Some(bf16) => {
                let weights = &self.backward[self.layers[index].backward.clone()];
                let Backward { gradient, outputs_len, first, activations, .. } = pass;
                let out = pass.inputs_gradient;
                bf16.backward(gradient, outputs_len, weights, first, activations, out);
            }
        }
    }

    /// Lends it to the threads that write it.
    pub fn pieces(&mut self) -> PackedPieces<'_> {
        PackedPieces {
            arithmetic: self.arithmetic,
            layers: &self.layers,
            panels: Disjoint::new(&mut self.panels),
            forward: Disjoint::new(&mut self.forward),
            backward: Disjoint::new(&mut self.backward),
        }
    }

    /// Takes over a network's flat parameters.
    pub fn fill(&mut self, shape: &MlpShape, parameters: &[f32]) {
        let pieces = self.pieces();
        for (index, layer) in shape.layers().iter().enumerate() {
            let weights = &parameters[layer.weights.clone()];
            // SAFETY: one layer after the other on this thread.
            unsafe { pieces.fill(shape, index, 0..layer.outputs, weights) };
        }
    }
}

impl PackedPieces<'_> {
    /// Takes over the weights of some outputs of layer `index`, (outputs.len(), inputs), that begin
    /// at a whole panel and end at one or with the layer.
    ///
    /// # Safety
    /// No two calls that run at the same time are given the same outputs.
    pub unsafe fn fill(
        &self,
        shape: &MlpShape,
        index: usize,
        outputs: Range<usize>,
        weights: &[f32],
    ) {
        let layer = &shape.layers()[index];
        let places = &self.layers[index];
        let inputs = layer.inputs;
        let ends = outputs.end == layer.outputs;
        // The last piece has the padding as well.
        let part = |place: &Range<usize>, before: usize, until: usize| {
            place.start + before..if ends { place.end } else { place.start + until }
        };
        match self.arithmetic.bf16(layer) {
            None => {
                let at = part(&places.panels, outputs.start * inputs, outputs.end * inputs);
                // SAFETY: other outputs have other places.
                let packed = unsafe { self.panels.slice(at) };
                pack(weights, inputs, layer.outputs, packed, self.arithmetic.instructions);
            }
            Some(bf16) => {
                let (start, end) = (outputs.start, outputs.end);
                let at = part(&places.forward, start * pairs(inputs), end * pairs(inputs));
                // SAFETY: as above.
                bf16.pack_forward(weights, inputs, unsafe { self.forward.slice(at) });
                let at = part(&places.backward, start / 2 * inputs, end / 2 * inputs);
                // SAFETY: as above; a panel has a whole number of pairs.
                bf16.pack_rows(weights, inputs, unsafe { self.backward.slice(at) });
            }
        }
    }
}
