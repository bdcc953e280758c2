//! A layer's forward pass.

use pulp::{Simd, WithSimd};

use super::pack::{NARROW, packed_len};
use super::tile::{Broadcast, Tiled, Wide, accumulate, for_rows, load, store, tile_width};
use super::{InstructionSet, PANEL};

/// The activation function of a layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// The identity, in the last layer.
    Linear,
    /// max(0, sum), in hidden layers.
    Relu,
}

/// Computes outputs = activation(inputs weightsᵀ + bias) for the rows of a shard.
#[derive(Debug)]
pub struct Forward<'a> {
    /// The layer's inputs, (rows, inputs).
    pub inputs: &'a [f32],
    /// The layer's weights, packed by [`super::pack`].
    pub packed: &'a [f32],
    /// The layer's bias, (outputs,).
    pub bias: &'a [f32],
    /// The layer's activation function.
    pub activation: Activation,
    /// The result, (rows, outputs).
    pub outputs: &'a mut [f32],
}

impl Forward<'_> {
    /// Computes the outputs.
    ///
    /// # Panics
    /// If the lengths are inconsistent.
    pub fn run(self, instructions: InstructionSet) {
        let width = self.bias.len();
        let rows = self.outputs.len() / width;
        assert_eq!(self.outputs.len(), rows * width, "outputs of {width} columns");
        let depth = self.inputs.len().checked_div(rows).unwrap_or(0);
        assert_eq!(self.inputs.len(), rows * depth, "inputs of {rows} rows");
        assert_eq!(self.packed.len(), packed_len(depth, width), "packed weights");
        instructions.run(Job { layer: self, rows, depth, width, column: 0 });
    }
}

struct Job<'a> {
    layer: Forward<'a>,
    rows: usize,
    depth: usize,
    width: usize,
    /// First column of the current tiles.
    column: usize,
}

impl WithSimd for Job<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        if self.width <= NARROW {
            return self.narrow(simd);
        }
        // The panels of a tile stay in the first- or second-level cache for all rows.
        while self.column < self.width {
            let width = tile_width::<S>(self.width - self.column);
            for_rows(simd, 0..self.rows, width, &mut self);
            self.column += width;
        }
    }
}

impl Job<'_> {
    /// Computes few outputs as dot products, because a panel would be mostly padding.
    #[inline(always)]
    fn narrow<S: Simd>(self, simd: S) {
        let Forward { inputs, packed, bias, activation, outputs } = self.layer;
        for row in 0..self.rows {
            let (inputs, tail) = S::as_simd_f32s(&inputs[row * self.depth..][..self.depth]);
            for column in 0..self.width {
                let weights = &packed[column * self.depth..][..self.depth];
                let (weights, weights_tail) = S::as_simd_f32s(weights);
                let mut sums = [simd.splat_f32s(0.0); 4];
                for (i, (input, weight)) in inputs.iter().zip(weights).enumerate() {
                    sums[i % 4] = simd.mul_add_e_f32s(*input, *weight, sums[i % 4]);
                }
                let sums = [0, 2].map(|i| simd.add_f32s(sums[i], sums[i + 1]));
                let mut sum = simd.reduce_sum_f32s(simd.add_f32s(sums[0], sums[1]));
                for (input, weight) in tail.iter().zip(weights_tail) {
                    sum += input * weight;
                }
                sum += bias[column];
                outputs[row * self.width + column] = match activation {
                    Activation::Linear => sum,
                    Activation::Relu => sum.max(0.0),
                };
            }
        }
    }
}

impl<S: Simd> Tiled<S> for Job<'_> {
    #[inline(always)]
    fn tile<const M: usize, const V: usize>(&mut self, simd: S, row: usize) {
        let Forward { inputs, packed, bias, activation, outputs } = &mut self.layer;
        let width = V * S::F32_LANES;
        let end = self.width.min(self.column + width);
        let sums = [load::<S, V>(simd, &bias[self.column..end]); M];
        let left = Broadcast {
            data: &inputs[row * self.depth..],
            row_stride: self.depth,
            depth_stride: 1,
        };
        let right = Wide {
            data: &packed[self.column * self.depth..][..self.depth * width],
            stride: PANEL,
            panel_stride: self.depth * PANEL,
            width,
            next: (row == 0).then_some(self.depth * width),
        };
        let sums = accumulate::<S, M, V, false>(simd, sums, left, right, self.depth);
        let zero = simd.splat_f32s(0.0);
        for (m, mut sums) in sums.into_iter().enumerate() {
            if *activation == Activation::Relu {
                for sum in &mut sums {
                    *sum = simd.max_f32s(*sum, zero);
                }
            }
            let at = (row + m) * self.width;
            store::<S, V>(simd, &mut outputs[at + self.column..at + end], sums);
        }
    }
}
