//! Copies of a network's weights in the orders in which its passes read them.

use std::ops::Range;

use dmprl_shared::policy::{Layer, MlpShape};

use super::arithmetic::Arithmetic;
use super::kernels::bf16::{Bf16Pair, forward_len, pair_count};
use super::kernels::{Activation, Backward, Forward, InstructionSet, pack, packed_len};
use super::thread_pool::DisjointSlice;

/// Copies of all layers' weights: panels for the forward pass or, for layers with 16-bit products,
/// pairs for both passes.
#[derive(Debug)]
pub struct PackedWeights {
    arithmetic: Arithmetic,
    panels: Vec<f32>,
    forward: Vec<Bf16Pair>,
    backward: Vec<Bf16Pair>,
    layers: Vec<PackedLayer>,
    /// [`crate::parameters::Parameters::revision`] of the parameters that were copied; 0 if none
    /// were yet.
    pub revision: u64,
}

/// A layer and the range of its weights in each copy.
#[derive(Debug, Clone, PartialEq, Eq)]
struct PackedLayer {
    layer: Layer,
    panels: Range<usize>,
    forward: Range<usize>,
    backward: Range<usize>,
}

/// Lets several threads write different outputs of the packed layers.
pub struct PackedWriter<'a> {
    arithmetic: Arithmetic,
    layers: &'a [PackedLayer],
    panels: DisjointSlice<'a, f32>,
    forward: DisjointSlice<'a, Bf16Pair>,
    backward: DisjointSlice<'a, Bf16Pair>,
}

impl PackedWeights {
    /// Allocates the copies for a network of this shape.
    #[must_use]
    pub fn new(shape: &MlpShape, arithmetic: Arithmetic) -> Self {
        let mut ends = [0; 3];
        let mut take = |index: usize, len: usize| {
            let begin = ends[index];
            ends[index] += len;
            begin..ends[index]
        };
        let packed_layer = |layer: &Layer| {
            let (inputs, outputs) = (layer.inputs, layer.outputs);
            let lens = match arithmetic.bf16(layer) {
                None => [packed_len(inputs, outputs), 0, 0],
                Some(_) => [0, forward_len(inputs, outputs), pair_count(outputs) * inputs],
            };
            PackedLayer {
                layer: layer.clone(),
                panels: take(0, lens[0]),
                forward: take(1, lens[1]),
                backward: take(2, lens[2]),
            }
        };
        let layers = shape.layers().iter().map(packed_layer).collect();
        let [panels, forward, backward] = ends;
        Self {
            arithmetic,
            panels: vec![0.0; panels],
            forward: vec![0; forward],
            backward: vec![0; backward],
            layers,
            revision: 0,
        }
    }

    /// Returns the vector instructions of the passes.
    #[must_use]
    pub fn instructions(&self) -> InstructionSet {
        self.arithmetic.instructions
    }

    /// Computes outputs = activation(inputs weightsᵀ + bias) of layer `index`. The bias is read
    /// from the flat `parameters`.
    pub fn forward(
        &self,
        index: usize,
        activation: Activation,
        parameters: &[f32],
        inputs: &[f32],
        outputs: &mut [f32],
    ) {
        let PackedLayer { layer, panels, forward, .. } = &self.layers[index];
        let bias = &parameters[layer.bias.clone()];
        match self.arithmetic.bf16(layer) {
            None => {
                let packed = &self.panels[panels.clone()];
                Forward { inputs, packed, bias, activation, outputs }
                    .run(self.arithmetic.instructions);
            }
            Some(bf16) => {
                let packed = &self.forward[forward.clone()];
                bf16.forward(inputs, packed, bias, activation, outputs);
            }
        }
    }

    /// Computes `pass`, a backward product of layer `index`.
    pub fn backward(&self, index: usize, pass: Backward<'_>) {
        let PackedLayer { layer, backward, .. } = &self.layers[index];
        match self.arithmetic.bf16(layer) {
            None => pass.run(self.arithmetic.instructions),
            Some(bf16) => {
                let weights = &self.backward[backward.clone()];
                let Backward { gradient, outputs_len, first, activations, .. } = pass;
                let out = pass.inputs_gradient;
                bf16.backward(gradient, outputs_len, weights, first, activations, out);
            }
        }
    }

    /// Returns a writer that several threads can share.
    pub fn writer(&mut self) -> PackedWriter<'_> {
        PackedWriter {
            arithmetic: self.arithmetic,
            layers: &self.layers,
            panels: DisjointSlice::new(&mut self.panels),
            forward: DisjointSlice::new(&mut self.forward),
            backward: DisjointSlice::new(&mut self.backward),
        }
    }

    /// Copies all weights from a network's flat parameters.
    pub fn fill(&mut self, parameters: &[f32]) {
        let writer = self.writer();
        for (index, PackedLayer { layer, .. }) in writer.layers.iter().enumerate() {
            let weights = &parameters[layer.weights.clone()];
            // SAFETY: this thread writes one layer after the other.
            unsafe { writer.fill(index, 0..layer.outputs, weights) };
        }
    }
}

impl PackedWriter<'_> {
    /// Copies the weights of some outputs of layer `index`, (outputs.len(), inputs). The range must
    /// begin at a whole panel, and end at one or with the layer.
    ///
    /// # Safety
    /// Calls that run at the same time must write different outputs.
    pub unsafe fn fill(&self, index: usize, outputs: Range<usize>, weights: &[f32]) {
        let PackedLayer { layer, panels, forward, backward } = &self.layers[index];
        let inputs = layer.inputs;
        let is_last = outputs.end == layer.outputs;
        // The last range includes the padding.
        let part = |all: &Range<usize>, begin: usize, end: usize| {
            all.start + begin..if is_last { all.end } else { all.start + end }
        };
        match self.arithmetic.bf16(layer) {
            None => {
                let range = part(panels, outputs.start * inputs, outputs.end * inputs);
                // SAFETY: different outputs have disjoint ranges.
                let packed = unsafe { self.panels.slice(range) };
                pack(weights, inputs, layer.outputs, packed, self.arithmetic.instructions);
            }
            Some(bf16) => {
                let (start, end) = (outputs.start, outputs.end);
                let depth = pair_count(inputs);
                let range = part(forward, start * depth, end * depth);
                // SAFETY: as above.
                bf16.pack_forward(weights, inputs, unsafe { self.forward.slice(range) });
                let range = part(backward, start / 2 * inputs, end / 2 * inputs);
                // SAFETY: as above; a panel has a whole number of pairs.
                bf16.pack_rows(weights, inputs, unsafe { self.backward.slice(range) });
            }
        }
    }
}
