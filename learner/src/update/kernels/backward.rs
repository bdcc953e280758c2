//! The gradient with respect to a layer's inputs.

use pulp::{Simd, WithSimd};

use super::tile::{Broadcast, Tiled, Wide, accumulate, for_rows, load, store, tile_width};
use super::{InstructionSet, PANEL, fill_panel, with_scratch};

/// The product gradient * weights for the rows of a shard, from column `first` of the inputs on.
#[derive(Debug)]
pub struct Backward<'a> {
    /// Gradient with respect to the layer's sums, (rows, outputs).
    pub gradient: &'a [f32],
    /// The layer's weights, (outputs, inputs), row-major as in the flat parameters.
    pub weights: &'a [f32],
    /// Width of the layer's output.
    pub outputs_len: usize,
    /// First input whose gradient is computed.
    pub first: usize,
    /// The layer's inputs, (rows, inputs - first), if they are outputs of a ReLU. The gradient is
    /// zero where they are.
    pub activations: Option<&'a [f32]>,
    /// The result, (rows, inputs - first).
    pub inputs_gradient: &'a mut [f32],
}

impl Backward<'_> {
    /// Computes the inputs' gradient.
    ///
    /// # Panics
    /// If the lengths are inconsistent.
    pub fn run(self, instructions: InstructionSet) {
        let depth = self.outputs_len;
        let rows = self.gradient.len() / depth;
        assert_eq!(self.gradient.len(), rows * depth, "gradient of {depth} columns");
        let inputs_len = self.weights.len() / depth;
        assert_eq!(self.weights.len(), depth * inputs_len, "weights of {depth} outputs");
        assert!(self.first < inputs_len, "column {} of {inputs_len}", self.first);
        let width = inputs_len - self.first;
        assert_eq!(self.inputs_gradient.len(), rows * width, "gradient of the inputs");
        let activations = self.activations.map_or(rows * width, <[f32]>::len);
        assert_eq!(activations, rows * width, "activations");
        with_scratch(depth * 2 * PANEL, |panels| {
            instructions.run(Job { layer: self, rows, width, inputs_len, column: 0, panels });
        });
    }
}

struct Job<'a> {
    layer: Backward<'a>,
    rows: usize,
    width: usize,
    inputs_len: usize,
    /// First column of the current tiles, relative to `first`.
    column: usize,
    /// The weights of the current tiles: one or two panels, each (outputs, [`PANEL`]).
    panels: &'a mut [f32],
}

impl WithSimd for Job<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        while self.column < self.width {
            let width = tile_width::<S>(self.width - self.column);
            let first = self.layer.first + self.column;
            let panels = self.panels.chunks_exact_mut(self.layer.outputs_len * PANEL);
            for (first, panel) in (first..first + width).step_by(PANEL).zip(panels) {
                let columns = first..self.inputs_len.min(first + PANEL);
                fill_panel(self.layer.weights.chunks_exact(self.inputs_len), columns, panel);
            }
            for_rows(simd, 0..self.rows, width, &mut self);
            self.column += width;
        }
    }
}

impl<S: Simd> Tiled<S> for Job<'_> {
    #[inline(always)]
    fn tile<const M: usize, const V: usize>(&mut self, simd: S, row: usize) {
        let zero = simd.splat_f32s(0.0);
        let depth = self.layer.outputs_len;
        let width = V * S::F32_LANES;
        let end = self.width.min(self.column + width);
        let left = Broadcast {
            data: &self.layer.gradient[row * depth..],
            row_stride: depth,
            depth_stride: 1,
        };
        let right = Wide {
            data: self.panels,
            stride: PANEL,
            panel_stride: depth * PANEL,
            width,
            next: None,
        };
        let sums = accumulate::<S, M, V, false>(simd, [[zero; V]; M], left, right, depth);
        for (m, mut sums) in sums.into_iter().enumerate() {
            let at = (row + m) * self.width;
            let columns = at + self.column..at + end;
            if let Some(activations) = self.layer.activations {
                let activations = load::<S, V>(simd, &activations[columns.clone()]);
                for (sum, activation) in sums.iter_mut().zip(activations) {
                    // A select instead of a branch, which would be mispredicted often.
                    let passed = simd.less_than_f32s(zero, activation);
                    *sum = simd.select_f32s(passed, *sum, zero);
                }
            }
            store::<S, V>(simd, &mut self.layer.inputs_gradient[columns], sums);
        }
    }
}
