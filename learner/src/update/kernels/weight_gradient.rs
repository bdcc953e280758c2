//! A layer's gradient with respect to its weights and bias.

use std::ops::Range;

use pulp::{Simd, WithSimd};

use super::tile::{Broadcast, Tiled, Wide, accumulate, for_rows, store};
use super::{InstructionSet, PANEL};

/// What one block of rows contributes.
#[derive(Debug, Clone, Copy)]
pub struct GradientBlock<'a> {
    /// Gradient with respect to the layer's outputs, (rows, outputs).
    pub gradient: &'a [f32],
    /// The layer's inputs, (rows, inputs).
    pub inputs: &'a [f32],
}

/// weights' gradient = Σ gradientᵀ inputs, bias' gradient = Σ gradient, over all blocks in the
/// order given, for some of the layer's outputs.
///
/// Whoever splits a layer over threads splits its outputs: each number is summed by one thread in
/// one order, so the number of threads changes nothing.
#[derive(Debug)]
pub struct WeightGradient<'a, I> {
    /// The blocks; run through once for each tile, so it should be cheap.
    pub blocks: I,
    /// Widths of the whole layer.
    pub inputs_len: usize,
    /// Width of the layer's output.
    pub outputs_len: usize,
    /// The outputs whose gradient is wanted.
    pub outputs: Range<usize>,
    /// (outputs.len(), inputs), overwritten.
    pub weights: &'a mut [f32],
    /// (outputs.len(),), overwritten.
    pub bias: &'a mut [f32],
}

impl<'b, I: Iterator<Item = GradientBlock<'b>> + Clone> WeightGradient<'_, I> {
    /// Computes both gradients.
    ///
    /// # Panics
    /// If the lengths do not fit.
    pub fn run(self, instructions: InstructionSet) {
        let Self { inputs_len, outputs_len, .. } = self;
        assert!(self.outputs.end <= outputs_len, "outputs {:?} of {outputs_len}", self.outputs);
        assert_eq!(self.weights.len(), self.outputs.len() * inputs_len, "weights' gradient");
        assert_eq!(self.bias.len(), self.outputs.len(), "bias' gradient");
        for block in self.blocks.clone() {
            let rows = block.gradient.len() / outputs_len;
            assert_eq!(block.gradient.len(), rows * outputs_len, "a block's gradient");
            assert_eq!(block.inputs.len(), rows * inputs_len, "a block's inputs");
        }
        instructions.run(Job { layer: self, column: 0 });
    }
}

struct Job<'a, I> {
    layer: WeightGradient<'a, I>,
    /// Where the panel at work begins.
    column: usize,
}

impl<'b, I: Iterator<Item = GradientBlock<'b>> + Clone> WithSimd for Job<'_, I> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        self.bias(simd);
        let outputs = self.layer.outputs.clone();
        // Tiles of one row of tiles follow each other: their part of the gradients stays near.
        for first in outputs.clone().step_by(PANEL) {
            self.column = 0;
            while self.column < self.layer.inputs_len {
                for_rows(simd, first..outputs.end.min(first + PANEL), &mut self);
                self.column += PANEL;
            }
        }
    }
}

impl<'b, I: Iterator<Item = GradientBlock<'b>> + Clone> Job<'_, I> {
    #[inline(always)]
    fn bias<S: Simd>(&mut self, simd: S) {
        let Range { start, end } = self.layer.outputs;
        let (body, tail) = S::as_mut_simd_f32s(self.layer.bias);
        let (lanes, tail_at) = (S::F32_LANES, end - tail.len());
        for (i, out) in body.iter_mut().enumerate() {
            let mut sum = simd.splat_f32s(0.0);
            for block in self.layer.blocks.clone() {
                for row in block.gradient.chunks_exact(self.layer.outputs_len) {
                    let (row, _) = S::as_simd_f32s(&row[start + i * lanes..][..lanes]);
                    sum = simd.add_f32s(sum, row[0]);
                }
            }
            *out = sum;
        }
        let mut sum = simd.splat_f32s(0.0);
        for block in self.layer.blocks.clone() {
            for row in block.gradient.chunks_exact(self.layer.outputs_len) {
                sum = simd.add_f32s(sum, simd.partial_load_f32s(&row[tail_at..end]));
            }
        }
        simd.partial_store_f32s(tail, sum);
    }
}

impl<'b, S: Simd, I: Iterator<Item = GradientBlock<'b>> + Clone> Tiled<S> for Job<'_, I> {
    #[inline(always)]
    fn tile<const M: usize, const V: usize>(&mut self, simd: S, row: usize) {
        let WeightGradient { inputs_len, outputs_len, .. } = self.layer;
        let end = inputs_len.min(self.column + PANEL);
        let width = end - self.column;
        let mut sums = [[simd.splat_f32s(0.0); V]; M];
        for block in self.layer.blocks.clone() {
            let rows = block.gradient.len() / outputs_len;
            if rows == 0 {
                continue;
            }
            let left = Broadcast {
                data: &block.gradient[row..],
                row_stride: 1,
                depth_stride: outputs_len,
            };
            let right = Wide { data: &block.inputs[self.column..], stride: inputs_len, width };
            sums = if width == PANEL {
                accumulate::<S, M, V, false>(simd, sums, left, right, rows)
            } else {
                accumulate::<S, M, V, true>(simd, sums, left, right, rows)
            };
        }
        for (m, sums) in sums.into_iter().enumerate() {
            let at = (row + m - self.layer.outputs.start) * inputs_len;
            store::<S, V>(simd, &mut self.layer.weights[at + self.column..at + end], sums);
        }
    }
}
