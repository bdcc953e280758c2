//! One step of Adam, cut into tiles for the threads. A tile also sums its part of the gradient.

use std::ops::Range;

use dmprl_shared::policy::{Layer, MlpShape};

use super::arithmetic::Arithmetic;
use super::bf16_operands::{Bf16Operands, LayerOperands};
use super::kernels::{
    AdamPass, GainGradient, GradientShard, NormalisedShard, PANEL, PolyakStep, StepSizes,
    WeightGradient, adam,
};
use super::layer_norm::{GainShift, LayerNorm};
use super::network::PassRecord;
use super::packed_weights::PackedWriter;
use super::thread_pool::DisjointSlice;

/// Outputs of a layer in one tile: a whole panel.
const TILE_OUTPUTS: usize = PANEL;

/// Some outputs of one layer: one part of the work.
#[derive(Debug, Clone)]
pub(super) struct Tile {
    layer: usize,
    outputs: Range<usize>,
}

/// Cuts a network into tiles.
pub(super) fn tiles(shape: &MlpShape) -> Vec<Tile> {
    let mut tiles = Vec::new();
    for (layer, Layer { outputs, .. }) in shape.layers().iter().enumerate() {
        let tile = |first| Tile { layer, outputs: first..(first + TILE_OUTPUTS).min(*outputs) };
        tiles.extend((0..*outputs).step_by(TILE_OUTPUTS).map(tile));
    }
    tiles
}

impl Tile {
    /// Returns the range of the tile's weights in the flat parameters.
    fn weights(&self, layer: &Layer) -> Range<usize> {
        let Range { start, end } = self.outputs.clone();
        layer.weights.start + start * layer.inputs..layer.weights.start + end * layer.inputs
    }

    /// Returns the range of the tile's biases in the flat parameters.
    fn bias(&self, layer: &Layer) -> Range<usize> {
        layer.bias.start + self.outputs.start..layer.bias.start + self.outputs.end
    }

    /// Returns the ranges of the tile's gains and shifts in the flat parameters.
    fn gain_shift(&self, layer: &GainShift) -> GainShift {
        let Range { start, end } = self.outputs.clone();
        let part = |all: &Range<usize>| all.start + start..all.start + end;
        GainShift { gain: part(&layer.gain), shift: part(&layer.shift) }
    }
}

/// A gradient summed over all shards, tile by tile. The threads share it.
pub(super) struct GradientSum<'a> {
    pub shape: &'a MlpShape,
    pub layer_norm: Option<&'a LayerNorm>,
    pub arithmetic: Arithmetic,
    /// Used by layers with 16-bit products.
    pub bf16_operands: &'a Bf16Operands,
    pub gradient: DisjointSlice<'a, f32>,
}

impl GradientSum<'_> {
    /// Sums one tile over the shards, in their order.
    pub fn tile<'b, B>(
        &self,
        tile: &Tile,
        shards: &'b [B],
        record: &impl Fn(&'b B) -> PassRecord<'b>,
    ) {
        let shape = self.shape;
        if let Some(gain_shift) = self.gain_shift(tile) {
            self.sum_gain_and_shift(tile, gain_shift, shards, record);
        }
        let shards = shards.iter().map(|shard| {
            let record = record(shard);
            let rows = record.inputs.len() / shape.inputs();
            let gradient = record.gradients.layer(shape, tile.layer, rows);
            GradientShard { gradient, inputs: record.layer_inputs(shape, tile.layer, rows) }
        });
        self.sum_weights_and_bias(tile, shards);
    }

    fn gain_shift(&self, tile: &Tile) -> Option<&GainShift> {
        self.layer_norm?.layer(tile.layer)
    }

    fn sum_gain_and_shift<'b, B>(
        &self,
        tile: &Tile,
        gain_shift: &GainShift,
        shards: &'b [B],
        record: &impl Fn(&'b B) -> PassRecord<'b>,
    ) {
        let shape = self.shape;
        let shards = shards.iter().map(|shard| {
            let record = record(shard);
            let rows = record.inputs.len() / shape.inputs();
            let normalised = record.normalised.expect("normalised values");
            let normalised = normalised.layer(shape, tile.layer, rows).values;
            let gradient = record.gradients.normalised_layer(shape, tile.layer, rows);
            NormalisedShard { gradient, normalised }
        });
        let GainShift { gain, shift } = tile.gain_shift(gain_shift);
        // SAFETY: tiles do not overlap, and neither do the gains and shifts of a tile.
        let (gain, shift) = unsafe { (self.gradient.slice(gain), self.gradient.slice(shift)) };
        let width = shape.layers()[tile.layer].outputs;
        let outputs = tile.outputs.clone();
        GainGradient { shards, width, outputs, gain, shift }.run(self.arithmetic.instructions);
    }

    fn sum_weights_and_bias<'b>(
        &self,
        tile: &Tile,
        shards: impl Iterator<Item = GradientShard<'b>>,
    ) {
        let layer = &self.shape.layers()[tile.layer];
        let (weights, bias) = (tile.weights(layer), tile.bias(layer));
        // SAFETY: tiles do not overlap, and neither do the weights and biases of a tile.
        let (weights, bias) = unsafe { (self.gradient.slice(weights), self.gradient.slice(bias)) };
        let outputs_len = layer.outputs;
        let outputs = tile.outputs.clone();
        let instructions = self.arithmetic.instructions;
        let Some(bf16) = self.arithmetic.bf16(layer) else {
            let inputs_len = layer.inputs;
            return WeightGradient { shards, inputs_len, outputs_len, outputs, weights, bias }
                .run(instructions);
        };
        let LayerOperands { inputs, gradient } = self.bf16_operands.layer(tile.layer);
        bf16.weight_gradient(gradient, outputs_len, outputs.clone(), inputs, weights);
        // Only the bias: a layer without inputs has no weights.
        let shards = shards.map(|shard| GradientShard { inputs: &[], ..shard });
        WeightGradient { shards, inputs_len: 0, outputs_len, outputs, weights: &mut [], bias }
            .run(instructions);
    }
}

/// One step of Adam on all tiles. The threads share it.
pub(super) struct TiledAdamStep<'a> {
    pub sum: GradientSum<'a>,
    pub sizes: StepSizes,
    pub polyak: Option<f32>,
    pub parameters: DisjointSlice<'a, f32>,
    /// Empty if there is no target network, or if it stays.
    pub target: DisjointSlice<'a, f32>,
    pub first: DisjointSlice<'a, f32>,
    pub second: DisjointSlice<'a, f32>,
    pub packed: PackedWriter<'a>,
    pub target_packed: PackedWriter<'a>,
}

impl TiledAdamStep<'_> {
    /// Updates gradient, parameters, target and packed copies of one tile, one after the other
    /// while they are in the cache.
    pub fn tile<'b, B>(
        &self,
        tile: &Tile,
        shards: &'b [B],
        record: &impl Fn(&'b B) -> PassRecord<'b>,
    ) {
        self.sum.tile(tile, shards, record);
        let (shape, outputs) = (self.sum.shape, tile.outputs.clone());
        let layer = &shape.layers()[tile.layer];
        let range = tile.weights(layer);
        self.adam(tile.bias(layer));
        self.adam(range.clone());
        if let Some(gain_shift) = self.sum.gain_shift(tile) {
            let GainShift { gain, shift } = tile.gain_shift(gain_shift);
            self.adam(gain);
            self.adam(shift);
        }
        // SAFETY: tiles do not overlap, and the slices above are no longer in use.
        unsafe {
            let weights = self.parameters.slice(range.clone());
            self.packed.fill(tile.layer, outputs.clone(), weights);
            if !self.target.is_empty() {
                let weights = self.target.slice(range);
                self.target_packed.fill(tile.layer, outputs, weights);
            }
        }
    }

    fn adam(&self, range: Range<usize>) {
        // SAFETY: a tile calls this for one range after the other, and tiles do not overlap.
        let pass = unsafe {
            AdamPass {
                parameters: self.parameters.slice(range.clone()),
                first: self.first.slice(range.clone()),
                second: self.second.slice(range.clone()),
                gradient: self.sum.gradient.slice(range.clone()),
                target_step: self
                    .polyak
                    .filter(|_| !self.target.is_empty())
                    .map(|polyak| PolyakStep { target: self.target.slice(range), polyak }),
                sizes: self.sizes,
            }
        };
        adam(pass, self.sum.arithmetic.instructions);
    }
}
