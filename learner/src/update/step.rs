//! One step of Adam along a gradient that is summed up on the way, cut into tiles for the threads.

use std::ops::Range;

use dmprl_shared::policy::{Layer, MlpShape};

use super::arithmetic::Arithmetic;
use super::batch_pairs::BatchPairs;
use super::crew::Disjoint;
use super::kernels::{
    AdamPass, Follow, GainGradient, GradientBlock, NormalisedBlock, PANEL, StepSizes,
    WeightGradient, adam,
};
use super::layer_norm::{GainShift, LayerNorm};
use super::packed::PackedPieces;
use super::trained::Trace;

/// Outputs of a layer whose gradient and step are one part of the work: a whole panel.
const TILE_OUTPUTS: usize = PANEL;

/// Some rows of one layer.
#[derive(Debug, Clone)]
pub(super) struct Tile {
    layer: usize,
    outputs: Range<usize>,
}

/// All tiles of a network.
pub(super) fn tiles(shape: &MlpShape) -> Vec<Tile> {
    let of_layer = |(layer, outputs): (usize, usize)| {
        (0..outputs)
            .step_by(TILE_OUTPUTS)
            .map(move |first| Tile { layer, outputs: first..(first + TILE_OUTPUTS).min(outputs) })
    };
    shape.layers().iter().map(|layer| layer.outputs).enumerate().flat_map(of_layer).collect()
}

impl Tile {
    /// Where its weights and its biases stand in the flat parameters.
    fn ranges(&self, layer: &Layer) -> [Range<usize>; 2] {
        let Range { start, end } = self.outputs.clone();
        let within = |first: usize, width: usize| first + start * width..first + end * width;
        [within(layer.weights.start, layer.inputs), within(layer.bias.start, 1)]
    }

    /// Where its gains and its shifts stand.
    fn norm_ranges(&self, places: &GainShift) -> [Range<usize>; 2] {
        let Range { start, end } = self.outputs.clone();
        [&places.gain, &places.shift].map(|place| place.start + start..place.start + end)
    }
}

/// What the threads that sum a gradient share.
pub(super) struct GradientSum<'a> {
    pub shape: &'a MlpShape,
    pub layer_norm: Option<&'a LayerNorm>,
    pub arithmetic: Arithmetic,
    /// Filled where the arithmetic has layers of 16 bits.
    pub pairs: &'a BatchPairs,
    pub gradient: Disjoint<'a, f32>,
}

impl GradientSum<'_> {
    /// One tile's part, summed over the blocks in their order.
    pub fn tile<'b, B>(&self, tile: &Tile, blocks: &'b [B], trace: &impl Fn(&'b B) -> Trace<'b>) {
        let shape = self.shape;
        if let Some(places) = self.norm_places(tile) {
            self.gain_and_shift(tile, places, blocks, trace);
        }
        let blocks = blocks.iter().map(|block| {
            let trace = trace(block);
            let rows = trace.inputs.len() / shape.inputs();
            let gradient = trace.gradients.layer(shape, tile.layer, rows);
            GradientBlock { gradient, inputs: trace.layer_inputs(shape, tile.layer, rows) }
        });
        self.weights_and_bias(tile, blocks);
    }

    fn norm_places(&self, tile: &Tile) -> Option<&GainShift> {
        self.layer_norm?.layer(tile.layer)
    }

    fn gain_and_shift<'b, B>(
        &self,
        tile: &Tile,
        places: &GainShift,
        blocks: &'b [B],
        trace: &impl Fn(&'b B) -> Trace<'b>,
    ) {
        let shape = self.shape;
        let blocks = blocks.iter().map(|block| {
            let trace = trace(block);
            let rows = trace.inputs.len() / shape.inputs();
            let normalised = trace.normalised.expect("normalised layers");
            let [normalised, _] = normalised.layer(shape, tile.layer, rows);
            let gradient = trace.gradients.normalised_layer(shape, tile.layer, rows);
            NormalisedBlock { gradient, normalised }
        });
        let [gain, shift] = tile.norm_ranges(places);
        // SAFETY: tiles do not overlap, nor do a tile's gains and shifts.
        let (gain, shift) = unsafe { (self.gradient.slice(gain), self.gradient.slice(shift)) };
        let width = shape.layers()[tile.layer].outputs;
        let outputs = tile.outputs.clone();
        GainGradient { blocks, width, outputs, gain, shift }.run(self.arithmetic.instructions);
    }

    fn weights_and_bias<'b>(&self, tile: &Tile, blocks: impl Iterator<Item = GradientBlock<'b>>) {
        let layer = &self.shape.layers()[tile.layer];
        let [weights, bias] = tile.ranges(layer);
        // SAFETY: tiles do not overlap, nor do a tile's weights and biases.
        let (weights, bias) = unsafe { (self.gradient.slice(weights), self.gradient.slice(bias)) };
        let outputs_len = layer.outputs;
        let outputs = tile.outputs.clone();
        let instructions = self.arithmetic.instructions;
        let Some(bf16) = self.arithmetic.bf16(layer) else {
            let inputs_len = layer.inputs;
            return WeightGradient { blocks, inputs_len, outputs_len, outputs, weights, bias }
                .run(instructions);
        };
        let [inputs, gradient] = self.pairs.layer(tile.layer);
        bf16.weight_gradient(gradient, outputs_len, outputs.clone(), inputs, weights);
        // The bias alone, of a layer without inputs.
        let blocks = blocks.map(|block| GradientBlock { inputs: &[], ..block });
        WeightGradient { blocks, inputs_len: 0, outputs_len, outputs, weights: &mut [], bias }
            .run(instructions);
    }
}

/// What the threads of one step of Adam share.
pub(super) struct Step<'a> {
    pub sum: GradientSum<'a>,
    pub sizes: StepSizes,
    pub polyak: Option<f32>,
    pub parameters: Disjoint<'a, f32>,
    /// Empty: no target follows.
    pub target: Disjoint<'a, f32>,
    pub first: Disjoint<'a, f32>,
    pub second: Disjoint<'a, f32>,
    pub packed: PackedPieces<'a>,
    pub target_packed: PackedPieces<'a>,
}

impl Step<'_> {
    /// Gradient, Adam, target and packed copies of one tile, one after the other while its numbers
    /// are in the cache.
    pub fn tile<'b, B>(&self, tile: &Tile, blocks: &'b [B], trace: &impl Fn(&'b B) -> Trace<'b>) {
        self.sum.tile(tile, blocks, trace);
        let (shape, outputs) = (self.sum.shape, tile.outputs.clone());
        let [weights_at, bias_at] = tile.ranges(&shape.layers()[tile.layer]);
        self.adam(bias_at);
        self.adam(weights_at.clone());
        if let Some(places) = self.sum.norm_places(tile) {
            tile.norm_ranges(places).into_iter().for_each(|range| self.adam(range));
        }
        // SAFETY: tiles do not overlap, and this one's slices above are no longer in use.
        unsafe {
            let weights = self.parameters.slice(weights_at.clone());
            self.packed.fill(shape, tile.layer, outputs.clone(), weights);
            if !self.target.is_empty() {
                let weights = self.target.slice(weights_at);
                self.target_packed.fill(shape, tile.layer, outputs, weights);
            }
        }
    }

    fn adam(&self, range: Range<usize>) {
        // SAFETY: called for ranges of one tile, one after the other, and tiles do not overlap.
        let pass = unsafe {
            AdamPass {
                parameters: self.parameters.slice(range.clone()),
                first: self.first.slice(range.clone()),
                second: self.second.slice(range.clone()),
                gradient: self.sum.gradient.slice(range.clone()),
                follow: self
                    .polyak
                    .filter(|_| !self.target.is_empty())
                    .map(|polyak| Follow { target: self.target.slice(range), polyak }),
                sizes: self.sizes,
            }
        };
        adam(pass, self.sum.arithmetic.instructions);
    }
}
