//! The fast map of a segment, in controller units.
//!
//! It runs for every decision and every sample of an update, once per action dimension. It does not
//! allocate, and the compiler vectorises it.

use super::{Dmp, STATE_INPUTS};
use crate::config::ForcingScaling;

/// Rows of a product that are computed together: two SSE registers or one AVX register.
const LANES: usize = 8;

/// Maps (y0, yd0, g, w) to the K samples that the inverse controller reads, in f32, for one action
/// dimension.
///
/// In controller units, samples are (y, yd / omega, ydd / omega^2), all of similar size. Weights
/// are the network's bounded outputs; `weight_scale` (weight_range * omega^2) is part of the
/// matrix. The matrix is computed in f64 and rounded once, so it is as accurate as f32 allows.
///     samples = M_s (y0, yd0, g) + factor M_w w,     factor = 1 or g - y0 (goal scaling)
#[derive(Debug, Clone, PartialEq)]
pub struct SegmentMap {
    segment_steps: usize,
    inputs: usize,
    omega: f32,
    forcing_scaling: ForcingScaling,
    matrix: Vec<f32>,
    forward: Panels,
    backward: Panels,
}

impl SegmentMap {
    /// Creates the map from the matrix of `dmp`.
    /// - `weight_scale`: DMP weight per unit of network output, weight_range * omega^2 \[u/s^2\].
    #[must_use]
    pub fn new(dmp: &Dmp, weight_scale: f64) -> Self {
        let (k, inputs) = (dmp.segment_steps(), STATE_INPUTS + dmp.basis_count());
        let scaled = |row: usize, column: usize| {
            let unit = dmp.omega().powi((row / k) as i32);
            let weight = if column < STATE_INPUTS { 1.0 } else { weight_scale };
            (dmp.matrix()[row * inputs + column] * weight / unit) as f32
        };
        let matrix: Vec<f32> =
            (0..3 * k).flat_map(|row| (0..inputs).map(move |column| scaled(row, column))).collect();
        Self {
            segment_steps: k,
            inputs,
            omega: dmp.omega() as f32,
            forcing_scaling: dmp.forcing_scaling(),
            forward: Panels::new(3 * k, inputs, |row, column| matrix[row * inputs + column]),
            backward: Panels::new(inputs, 3 * k, |row, column| matrix[column * inputs + row]),
            matrix,
        }
    }

    /// Number of inputs of one dimension, 3 + N.
    #[must_use]
    pub fn input_count(&self) -> usize {
        self.inputs
    }

    /// Number of samples of one dimension, 3K.
    #[must_use]
    pub fn sample_count(&self) -> usize {
        3 * self.segment_steps
    }

    /// Computes the segment of one dimension.
    /// - `inputs`: (3 + N,) y0, yd0 in DMP units, g, and weights as the network's outputs.
    /// - `samples`: (3K,) y_k, then yd_k / omega, then ydd_k / omega^2; overwritten.
    /// # Panics
    /// If a length is wrong.
    pub fn forward(&self, inputs: &[f32], samples: &mut [f32]) {
        self.check(inputs, samples.len());
        let factor = match self.forcing_scaling {
            ForcingScaling::None => 1.0,
            ForcingScaling::Goal => inputs[2] - inputs[0],
        };
        let (state, weights) = inputs.split_at(STATE_INPUTS);
        for (panel, out) in self.forward.iter().zip(samples.chunks_mut(LANES)) {
            let (of_state, of_weights) = panel.split_at(STATE_INPUTS);
            let (mut sum, forced) = (product(of_state, state), product(of_weights, weights));
            for (sum, forced) in sum.iter_mut().zip(forced) {
                *sum += factor * forced;
            }
            out.copy_from_slice(&sum[..out.len()]);
        }
    }

    /// Computes the gradient with respect to the inputs.
    /// - `inputs`: (3 + N,) as passed to [`forward`](Self::forward).
    /// - `samples_gradient`: (3K,). `inputs_gradient`: (3 + N,), overwritten.
    /// # Panics
    /// If a length is wrong.
    pub fn backward(&self, inputs: &[f32], samples_gradient: &[f32], inputs_gradient: &mut [f32]) {
        self.check(inputs, samples_gradient.len());
        assert_eq!(inputs_gradient.len(), self.inputs, "one gradient per input");
        for (panel, out) in self.backward.iter().zip(inputs_gradient.chunks_mut(LANES)) {
            out.copy_from_slice(&product(panel, samples_gradient)[..out.len()]);
        }
        if self.forcing_scaling == ForcingScaling::Goal {
            let factor = inputs[2] - inputs[0];
            let (of_state, of_weights) = inputs_gradient.split_at_mut(STATE_INPUTS);
            let mut of_factor = 0.0;
            for (gradient, w) in of_weights.iter_mut().zip(&inputs[STATE_INPUTS..]) {
                of_factor += *gradient * w;
                *gradient *= factor;
            }
            of_state[0] -= of_factor;
            of_state[2] += of_factor;
        }
    }

    /// Returns the end state of the segment in DMP units, (y_K, yd_K). With `start = "carry"` it is
    /// the next segment's (y0, yd0).
    /// - `samples`: (3K,) from [`forward`](Self::forward).
    /// # Panics
    /// If the length is wrong.
    #[must_use]
    pub fn end_state(&self, samples: &[f32]) -> (f32, f32) {
        assert_eq!(samples.len(), self.sample_count(), "3K samples");
        let k = self.segment_steps;
        (samples[k - 1], samples[2 * k - 1] * self.omega)
    }

    /// The matrix in controller units, (3K) x (3 + N), row-major.
    #[must_use]
    pub fn matrix(&self) -> &[f32] {
        &self.matrix
    }

    fn check(&self, inputs: &[f32], sample_count: usize) {
        assert_eq!(inputs.len(), self.inputs, "3 + N inputs");
        assert_eq!(sample_count, self.sample_count(), "3K samples");
    }
}

/// A matrix in blocks of [`LANES`] rows, each stored column by column and padded with zeros.
///
/// A product keeps a block's sums in registers and needs no horizontal sum and no remainder loop.
#[derive(Debug, Clone, PartialEq)]
struct Panels {
    columns: usize,
    data: Vec<[f32; LANES]>,
}

impl Panels {
    fn new(rows: usize, columns: usize, entry: impl Fn(usize, usize) -> f32) -> Self {
        let mut data = Vec::with_capacity(rows.div_ceil(LANES) * columns);
        for first in (0..rows).step_by(LANES) {
            for column in 0..columns {
                data.push(std::array::from_fn(|lane| match first + lane {
                    row if row < rows => entry(row, column),
                    _ => 0.0,
                }));
            }
        }
        Self { columns, data }
    }

    fn iter(&self) -> impl Iterator<Item = &[[f32; LANES]]> {
        self.data.chunks_exact(self.columns)
    }
}

fn product(panel: &[[f32; LANES]], vector: &[f32]) -> [f32; LANES] {
    let mut sum = [0.0; LANES];
    for (column, value) in panel.iter().zip(vector) {
        for (sum, entry) in sum.iter_mut().zip(column) {
            *sum += entry * value;
        }
    }
    sum
}
