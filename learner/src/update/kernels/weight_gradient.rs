//! The gradient with respect to a layer's weights and bias.

use std::ops::Range;

use pulp::{Simd, WithSimd};

use super::tile::{Broadcast, Tiled, Wide, accumulate, for_rows, load, store, tile_width};
use super::{InstructionSet, PANEL, fill_panel, with_scratch};

/// Shards that a tile sums before it stores the result. They are collected first, because calling
/// an iterator in the middle of a tile would spill the tile's registers.
const SHARDS_AT_ONCE: usize = 32;

/// Operands from one shard.
#[derive(Debug, Clone, Copy, Default)]
pub struct GradientShard<'a> {
    /// Gradient with respect to the layer's sums, (rows, outputs).
    pub gradient: &'a [f32],
    /// The layer's inputs, (rows, inputs).
    pub inputs: &'a [f32],
}

/// Sums the gradients of weights, Σ gradientᵀ inputs, and bias, Σ gradient, over all shards in
/// their order, for some of the layer's outputs.
///
/// To use several threads, split the outputs. One thread then sums each number in a fixed order, so
/// the number of threads changes no bit.
#[derive(Debug)]
pub struct WeightGradient<'a, I> {
    /// The shards, in their order.
    pub shards: I,
    /// Width of the layer's input.
    pub inputs_len: usize,
    /// Width of the layer's output.
    pub outputs_len: usize,
    /// Outputs whose gradient is computed.
    pub outputs: Range<usize>,
    /// Gradient of the weights, (outputs.len(), inputs).
    pub weights: &'a mut [f32],
    /// Gradient of the bias, (outputs.len(),).
    pub bias: &'a mut [f32],
}

impl<'b, I: Iterator<Item = GradientShard<'b>>> WeightGradient<'_, I> {
    /// Computes both gradients.
    ///
    /// # Panics
    /// If the lengths are inconsistent.
    pub fn run(self, instructions: InstructionSet) {
        let Self { mut shards, inputs_len, outputs_len, outputs, weights, bias } = self;
        assert!(outputs.end <= outputs_len, "outputs {outputs:?} of {outputs_len}");
        assert_eq!(weights.len(), outputs.len() * inputs_len, "weights' gradient");
        assert_eq!(bias.len(), outputs.len(), "bias' gradient");
        let mut accumulate_onto = false;
        loop {
            let mut group = [GradientShard::default(); SHARDS_AT_ONCE];
            let mut len = 0;
            for (place, shard) in group.iter_mut().zip(&mut shards) {
                let rows = shard.gradient.len() / outputs_len;
                assert_eq!(shard.gradient.len(), rows * outputs_len, "a shard's gradient");
                assert_eq!(shard.inputs.len(), rows * inputs_len, "a shard's inputs");
                *place = shard;
                len += 1;
            }
            if len == 0 && accumulate_onto {
                return;
            }
            let rows = group.iter().map(|shard| shard.gradient.len() / outputs_len).sum::<usize>();
            with_scratch(rows * PANEL, |gradient| {
                instructions.run(Job {
                    shards: &group[..len],
                    inputs_len,
                    outputs_len,
                    outputs: outputs.clone(),
                    weights: &mut *weights,
                    bias: &mut *bias,
                    accumulate_onto,
                    column: 0,
                    gradient,
                });
            });
            accumulate_onto = true;
        }
    }
}

/// Adds some shards to the gradients.
struct Job<'a> {
    shards: &'a [GradientShard<'a>],
    inputs_len: usize,
    outputs_len: usize,
    outputs: Range<usize>,
    weights: &'a mut [f32],
    bias: &'a mut [f32],
    /// Whether the gradients already contain earlier shards.
    accumulate_onto: bool,
    /// First column of the current tiles.
    column: usize,
    /// The gradient of the current panel of outputs, (rows of all shards, [`PANEL`]).
    gradient: &'a mut [f32],
}

impl WithSimd for Job<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        self.bias(simd);
        if self.inputs_len == 0 {
            return;
        }
        let outputs = self.outputs.clone();
        // Row by row of tiles, so that a tile's rows of the gradient are still in the cache.
        for first in outputs.clone().step_by(PANEL) {
            let panel = first..outputs.end.min(first + PANEL);
            let rows = self.shards.iter().flat_map(|s| s.gradient.chunks_exact(self.outputs_len));
            fill_panel(rows, panel.clone(), self.gradient);
            self.column = 0;
            while self.column < self.inputs_len {
                let width = tile_width::<S>(self.inputs_len - self.column);
                for_rows(simd, panel.clone(), width, &mut self);
                self.column += width;
            }
        }
    }
}

impl Job<'_> {
    #[inline(always)]
    fn bias<S: Simd>(&mut self, simd: S) {
        // Whole vectors of columns first, then the remaining columns one by one.
        let (vectors, rest) = S::as_mut_simd_f32s(self.bias);
        let mut first = self.outputs.start;
        for out in vectors {
            let mut sum = if self.accumulate_onto { *out } else { simd.splat_f32s(0.0) };
            for shard in self.shards {
                for row in shard.gradient.chunks_exact(self.outputs_len) {
                    let (row, _) = S::as_simd_f32s(&row[first..first + S::F32_LANES]);
                    sum = simd.add_f32s(sum, row[0]);
                }
            }
            *out = sum;
            first += S::F32_LANES;
        }
        for out in rest {
            let mut sum = if self.accumulate_onto { *out } else { 0.0 };
            for shard in self.shards {
                sum += shard.gradient.iter().skip(first).step_by(self.outputs_len).sum::<f32>();
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
        let tile_width = V * S::F32_LANES;
        let end = inputs_len.min(self.column + tile_width);
        let width = end - self.column;
        let first = (row - self.outputs.start) * inputs_len;
        let columns = |m: usize| first + m * inputs_len + self.column..first + m * inputs_len + end;
        let mut sums = [[simd.splat_f32s(0.0); V]; M];
        if self.accumulate_onto {
            for (m, sums) in sums.iter_mut().enumerate() {
                *sums = load::<S, V>(simd, &self.weights[columns(m)]);
            }
        }
        let first_row = (row - self.outputs.start) % PANEL;
        let mut gradient = &self.gradient[first_row..];
        for shard in self.shards {
            let rows = shard.gradient.len() / outputs_len;
            if rows == 0 {
                continue;
            }
            let left = Broadcast { data: gradient, row_stride: 1, depth_stride: PANEL };
            let right = Wide {
                data: &shard.inputs[self.column..],
                stride: inputs_len,
                panel_stride: PANEL,
                width,
                next: (first_row == 0).then_some(tile_width),
            };
            sums = if width == tile_width {
                accumulate::<S, M, V, false>(simd, sums, left, right, rows)
            } else {
                accumulate::<S, M, V, true>(simd, sums, left, right, rows)
            };
            gradient = gradient.get(rows * PANEL..).unwrap_or_default();
        }
        for (m, sums) in sums.into_iter().enumerate() {
            store::<S, V>(simd, &mut self.weights[columns(m)], sums);
        }
    }
}
