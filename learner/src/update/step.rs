//! One step of Adam along a gradient that is summed up on the way, cut into tiles for the threads.

use std::ops::Range;

use dmprl_shared::policy::{Layer, MlpShape};

use super::arithmetic::Arithmetic;
use super::batch_pairs::BatchPairs;
use super::crew::Disjoint;
use super::kernels::{AdamPass, Follow, GradientBlock, PANEL, StepSizes, WeightGradient, adam};
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

/// What the threads of one step of Adam share.
pub(super) struct Step<'a> {
    pub shape: &'a MlpShape,
    pub sizes: StepSizes,
    pub polyak: Option<f32>,
    pub arithmetic: Arithmetic,
    /// Filled where the arithmetic has layers of 16 bits.
    pub pairs: &'a BatchPairs,
    pub parameters: Disjoint<'a, f32>,
    /// Empty: no target follows.
    pub target: Disjoint<'a, f32>,
    pub gradient: Disjoint<'a, f32>,
    pub first: Disjoint<'a, f32>,
    pub second: Disjoint<'a, f32>,
    pub packed: PackedPieces<'a>,
    pub target_packed: PackedPieces<'a>,
}

impl Step<'_> {
    /// Gradient, Adam, target and packed copies of one tile, one after the other while its numbers
    /// are in the cache.
    pub fn tile<'b, B>(&self, tile: &Tile, blocks: &'b [B], trace: &impl Fn(&'b B) -> Trace<'b>) {
        let (shape, outputs) = (self.shape, tile.outputs.clone());
        let layer = &shape.layers()[tile.layer];
        let within =
            |begin: usize, width: usize| begin + outputs.start * width..begin + outputs.end * width;
        let weights_at = within(layer.weights.start, layer.inputs);
        let bias_at = within(layer.bias.start, 1);
        let gradient_blocks = blocks.iter().map(|block| {
            let trace = trace(block);
            let rows = trace.inputs.len() / shape.inputs();
            let gradient = trace.gradients.layer(shape, tile.layer, rows);
            GradientBlock { gradient, inputs: trace.layer_inputs(shape, tile.layer, rows) }
        });
        // SAFETY: tiles do not overlap, nor do a tile's weights and biases.
        let (weights, bias) = unsafe {
            (self.gradient.slice(weights_at.clone()), self.gradient.slice(bias_at.clone()))
        };
        self.gradients(tile, layer, gradient_blocks, weights, bias);
        self.adam(bias_at);
        self.adam(weights_at.clone());
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

    fn gradients<'b>(
        &self,
        tile: &Tile,
        layer: &Layer,
        blocks: impl Iterator<Item = GradientBlock<'b>>,
        weights: &mut [f32],
        bias: &mut [f32],
    ) {
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

    fn adam(&self, range: Range<usize>) {
        // SAFETY: called for ranges of one tile, one after the other, and tiles do not overlap.
        let pass = unsafe {
            AdamPass {
                parameters: self.parameters.slice(range.clone()),
                first: self.first.slice(range.clone()),
                second: self.second.slice(range.clone()),
                gradient: self.gradient.slice(range.clone()),
                follow: self
                    .polyak
                    .filter(|_| !self.target.is_empty())
                    .map(|polyak| Follow { target: self.target.slice(range), polyak }),
                sizes: self.sizes,
            }
        };
        adam(pass, self.arithmetic.instructions);
    }
}
