//! A layer's gradient with respect to its weights and bias.

use std::ops::Range;

use pulp::{Simd, WithSimd};

use super::tile::{Broadcast, Tiled, Wide, accumulate, for_rows, load, store};
use super::{InstructionSet, PANEL};

/// Blocks that a tile sums up before it stores. They are collected first: to ask an iterator in
/// the middle of a tile would push the tile out of the registers.
const BLOCKS: usize = 32;

/// What one block of rows contributes.
#[derive(Debug, Clone, Copy, Default)]
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
    /// The blocks, in their order.
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

impl<'b, I: Iterator<Item = GradientBlock<'b>>> WeightGradient<'_, I> {
    /// Computes both gradients.
    ///
    /// # Panics
    /// If the lengths do not fit.
    pub fn run(self, instructions: InstructionSet) {
        let Self { mut blocks, inputs_len, outputs_len, outputs, weights, bias } = self;
        assert!(outputs.end <= outputs_len, "outputs {outputs:?} of {outputs_len}");
        assert_eq!(weights.len(), outputs.len() * inputs_len, "weights' gradient");
        assert_eq!(bias.len(), outputs.len(), "bias' gradient");
        let mut earlier = false;
        loop {
            let mut group = [GradientBlock::default(); BLOCKS];
            let mut len = 0;
            for (place, block) in group.iter_mut().zip(&mut blocks) {
                let rows = block.gradient.len() / outputs_len;
                assert_eq!(block.gradient.len(), rows * outputs_len, "a block's gradient");
                assert_eq!(block.inputs.len(), rows * inputs_len, "a block's inputs");
                *place = block;
                len += 1;
            }
            if len == 0 && earlier {
                return;
            }
            instructions.run(Job {
                blocks: &group[..len],
                inputs_len,
                outputs_len,
                outputs: outputs.clone(),
                weights: &mut *weights,
                bias: &mut *bias,
                earlier,
                column: 0,
            });
            earlier = true;
        }
    }
}

/// The part of some blocks in the gradients.
struct Job<'a> {
    blocks: &'a [GradientBlock<'a>],
    inputs_len: usize,
    outputs_len: usize,
    outputs: Range<usize>,
    weights: &'a mut [f32],
    bias: &'a mut [f32],
    /// Whether the gradients hold what earlier blocks added.
    earlier: bool,
    /// Where the panel at work begins.
    column: usize,
}

impl WithSimd for Job<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        self.bias(simd);
        let outputs = self.outputs.clone();
        // Tiles of one row of tiles follow each other: their part of the gradients stays near.
        for first in outputs.clone().step_by(PANEL) {
            self.column = 0;
            while self.column < self.inputs_len {
                for_rows(simd, first..outputs.end.min(first + PANEL), &mut self);
                self.column += PANEL;
            }
        }
    }
}

impl Job<'_> {
    #[inline(always)]
    fn bias<S: Simd>(&mut self, simd: S) {
        // As many columns as a vector has, and what is left one by one.
        let (vectors, rest) = S::as_mut_simd_f32s(self.bias);
        let mut first = self.outputs.start;
        for out in vectors {
            let mut sum = if self.earlier { *out } else { simd.splat_f32s(0.0) };
            for block in self.blocks {
                for row in block.gradient.chunks_exact(self.outputs_len) {
                    let (row, _) = S::as_simd_f32s(&row[first..first + S::F32_LANES]);
                    sum = simd.add_f32s(sum, row[0]);
                }
            }
            *out = sum;
            first += S::F32_LANES;
        }
        for out in rest {
            let mut sum = if self.earlier { *out } else { 0.0 };
            for block in self.blocks {
                sum += block.gradient.iter().skip(first).step_by(self.outputs_len).sum::<f32>();
            }
            *out = sum;
            first += 1;
        }
    }
}

impl<S: Simd> Tiled<S> for Job<'_> {
    #[inline(always)]
    fn tile<const M: usize, const V: usize>(&mut self, simd: S, row: usize) {
        let Self { inputs_len, outputs_len, .. } = *self;
        let end = inputs_len.min(self.column + PANEL);
        let width = end - self.column;
        let first = (row - self.outputs.start) * inputs_len;
        let columns = |m: usize| first + m * inputs_len + self.column..first + m * inputs_len + end;
        let mut sums = [[simd.splat_f32s(0.0); V]; M];
        if self.earlier {
            for (m, sums) in sums.iter_mut().enumerate() {
                *sums = load::<S, V>(simd, &self.weights[columns(m)]);
            }
        }
        for block in self.blocks {
            let rows = block.gradient.len() / outputs_len;
            if rows == 0 {
                continue;
            }
            let gradient = &block.gradient[row..];
            let left = Broadcast { data: gradient, row_stride: 1, depth_stride: outputs_len };
            let inputs = &block.inputs[self.column..];
            let right = Wide { data: inputs, stride: inputs_len, width, next: None };
            sums = if width == PANEL {
                accumulate::<S, M, V, false>(simd, sums, left, right, rows)
            } else {
                accumulate::<S, M, V, true>(simd, sums, left, right, rows)
            };
        }
        for (m, sums) in sums.into_iter().enumerate() {
            store::<S, V>(simd, &mut self.weights[columns(m)], sums);
        }
    }
}
