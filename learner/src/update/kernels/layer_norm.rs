//! Layer normalisation (Ba et al. 2016) between a layer's sums and its ReLU, row by row:
//!
//! normalised = (x - mean) / sqrt(variance + epsilon), output = max(0, gain normalised + shift)
//!
//! Mean and variance are over the row's n sums. The variance is divided by n, not n - 1, as in
//! PyTorch's `LayerNorm`. A row fits into the first-level cache, so passes over it cost little.

use std::ops::Range;

use pulp::{Simd, WithSimd};

use super::InstructionSet;

/// Added to a row's variance, as by default in PyTorch.
pub(crate) const VARIANCE_EPSILON: f32 = 1e-5;

/// Normalises, scales and shifts the rows of a shard and applies the ReLU.
#[derive(Debug)]
pub struct Normalise<'a> {
    /// The layer's sums, (rows, width), which are replaced by the normalised values.
    pub values: &'a mut [f32],
    /// Receives 1 / sqrt(variance + epsilon), (rows,).
    pub inverse_std: &'a mut [f32],
    /// The layer's gain, (width,).
    pub gain: &'a [f32],
    /// The layer's shift, (width,).
    pub shift: &'a [f32],
    /// Receives the outputs, (rows, width).
    pub outputs: &'a mut [f32],
}

impl Normalise<'_> {
    /// Computes normalised values and outputs.
    ///
    /// # Panics
    /// If the lengths are inconsistent.
    pub fn run(self, instructions: InstructionSet) {
        let (width, len) = (self.gain.len(), self.outputs.len());
        assert_eq!(self.shift.len(), width, "shift");
        assert_eq!(self.values.len(), len, "normalised values");
        assert_eq!(self.inverse_std.len() * width, len, "rows of {width} columns");
        instructions.run(self);
    }
}

impl WithSimd for Normalise<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let width = self.gain.len();
        let share = 1.0 / width as f32;
        let rows = self.values.chunks_exact_mut(width).zip(self.outputs.chunks_exact_mut(width));
        for ((row, out), inverse_std) in rows.zip(self.inverse_std) {
            let mean = sum(simd, row) * share;
            let variance = centre(simd, row, mean) * share;
            *inverse_std = 1.0 / (variance + VARIANCE_EPSILON).sqrt();
            let (gain, shift) = (self.gain, self.shift);
            ScaleShiftRelu { row, inverse_std: *inverse_std, gain, shift, out }.run(simd);
        }
    }
}

/// Computes the gradient at a layer's sums from the gradient after normalisation.
#[derive(Debug)]
pub struct NormaliseBackward<'a> {
    /// Gradient with respect to the scaled and shifted values, masked by the ReLU, (rows, width).
    pub gradient: &'a [f32],
    /// Normalised values from [`Normalise`], (rows, width).
    pub normalised: &'a [f32],
    /// 1 / sqrt(variance + epsilon) from [`Normalise`], (rows,).
    pub inverse_std: &'a [f32],
    /// The layer's gain, (width,).
    pub gain: &'a [f32],
    /// Receives the gradient with respect to the sums, (rows, width).
    pub sums_gradient: &'a mut [f32],
}

impl NormaliseBackward<'_> {
    /// Computes inverse_std (s - mean(s) - z mean(s z)), where s = gradient gain and z are the
    /// normalised values.
    ///
    /// # Panics
    /// If the lengths are inconsistent.
    pub fn run(self, instructions: InstructionSet) {
        let (width, len) = (self.gain.len(), self.gradient.len());
        assert_eq!(self.normalised.len(), len, "normalised values");
        assert_eq!(self.sums_gradient.len(), len, "gradient of the sums");
        assert_eq!(self.inverse_std.len() * width, len, "rows of {width} columns");
        instructions.run(self);
    }
}

impl WithSimd for NormaliseBackward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let width = self.gain.len();
        let share = 1.0 / width as f32;
        let rows = self.gradient.chunks_exact(width).zip(self.normalised.chunks_exact(width));
        let rows = rows.zip(self.sums_gradient.chunks_exact_mut(width));
        for (((gradient, normalised), out), inverse_std) in rows.zip(self.inverse_std) {
            let sums = scale(simd, gradient, self.gain, normalised, out);
            let projection = Projection {
                mean: sums.plain * share,
                slope: sums.with_normalised * share,
                inverse_std: *inverse_std,
            };
            projection.apply(simd, normalised, out);
        }
    }
}

/// Operands of the gradients of gain and shift from one shard.
#[derive(Debug, Clone, Copy)]
pub struct NormalisedShard<'a> {
    /// Gradient with respect to the scaled and shifted values, masked by the ReLU, (rows, width).
    pub gradient: &'a [f32],
    /// Normalised values, (rows, width).
    pub normalised: &'a [f32],
}

/// Sums the gradients of gain, Σ gradient normalised, and shift, Σ gradient, over the rows of all
/// shards in their order, for some of the layer's outputs.
#[derive(Debug)]
pub struct GainGradient<'a, I> {
    /// The shards, in their order.
    pub shards: I,
    /// Width of the layer's output.
    pub width: usize,
    /// Outputs whose gradient is computed.
    pub outputs: Range<usize>,
    /// Receives the gradient of the gain, (outputs.len(),).
    pub gain: &'a mut [f32],
    /// Receives the gradient of the shift, (outputs.len(),).
    pub shift: &'a mut [f32],
}

impl<'b, I: Iterator<Item = NormalisedShard<'b>>> GainGradient<'_, I> {
    /// Computes both gradients.
    ///
    /// # Panics
    /// If the lengths are inconsistent.
    pub fn run(self, instructions: InstructionSet) {
        let Self { shards, width, outputs, gain, shift } = self;
        assert!(outputs.end <= width, "outputs {outputs:?} of {width}");
        assert_eq!([gain.len(), shift.len()], [outputs.len(); 2], "gradients of gain and shift");
        gain.fill(0.0);
        shift.fill(0.0);
        for shard in shards {
            assert_eq!(shard.gradient.len(), shard.normalised.len(), "a shard");
            let first = outputs.start;
            instructions.run(Job { shard, width, first, gain: &mut *gain, shift: &mut *shift });
        }
    }
}

/// Adds one shard to the gradients.
struct Job<'a> {
    shard: NormalisedShard<'a>,
    width: usize,
    first: usize,
    gain: &'a mut [f32],
    shift: &'a mut [f32],
}

impl WithSimd for Job<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let len = self.gain.len();
        for from in (0..len).step_by(S::F32_LANES) {
            let to = len.min(from + S::F32_LANES);
            let columns = self.first + from..self.first + to;
            let mut gain = simd.partial_load_f32s(&self.gain[from..to]);
            let mut shift = simd.partial_load_f32s(&self.shift[from..to]);
            let rows = self.shard.gradient.chunks_exact(self.width);
            for (gradient, normalised) in rows.zip(self.shard.normalised.chunks_exact(self.width)) {
                let gradient = simd.partial_load_f32s(&gradient[columns.clone()]);
                let normalised = simd.partial_load_f32s(&normalised[columns.clone()]);
                gain = simd.mul_add_e_f32s(gradient, normalised, gain);
                shift = simd.add_f32s(shift, gradient);
            }
            simd.partial_store_f32s(&mut self.gain[from..to], gain);
            simd.partial_store_f32s(&mut self.shift[from..to], shift);
        }
    }
}

/// Returns Σ row, summed in four parts so that no addition waits for the previous one.
#[inline(always)]
fn sum<S: Simd>(simd: S, row: &[f32]) -> f32 {
    let (vectors, tail) = S::as_simd_f32s(row);
    let (fours, rest) = vectors.as_chunks::<4>();
    let mut sums = [simd.splat_f32s(0.0); 4];
    for four in fours {
        for (sum, x) in sums.iter_mut().zip(four) {
            *sum = simd.add_f32s(*sum, *x);
        }
    }
    for (sum, x) in sums.iter_mut().zip(rest) {
        *sum = simd.add_f32s(*sum, *x);
    }
    sums[3] = simd.add_f32s(sums[3], simd.partial_load_f32s(tail));
    total(simd, sums)
}

/// Subtracts `mean` from the row and returns the sum of its squares.
#[inline(always)]
fn centre<S: Simd>(simd: S, row: &mut [f32], mean: f32) -> f32 {
    let mean = simd.splat_f32s(mean);
    let (vectors, tail) = S::as_mut_simd_f32s(row);
    let (fours, rest) = vectors.as_chunks_mut::<4>();
    let mut sums = [simd.splat_f32s(0.0); 4];
    for four in fours {
        for (sum, x) in sums.iter_mut().zip(four) {
            *x = simd.sub_f32s(*x, mean);
            *sum = simd.mul_add_e_f32s(*x, *x, *sum);
        }
    }
    for (sum, x) in sums.iter_mut().zip(rest) {
        *x = simd.sub_f32s(*x, mean);
        *sum = simd.mul_add_e_f32s(*x, *x, *sum);
    }
    let centred = simd.sub_f32s(simd.partial_load_f32s(tail), mean);
    simd.partial_store_f32s(tail, centred);
    // Loaded again, because the lanes beyond the tail must be zero instead of -mean.
    let centred = simd.partial_load_f32s(tail);
    sums[3] = simd.mul_add_e_f32s(centred, centred, sums[3]);
    total(simd, sums)
}

#[inline(always)]
fn total<S: Simd>(simd: S, [a, b, c, d]: [S::f32s; 4]) -> f32 {
    simd.reduce_sum_f32s(simd.add_f32s(simd.add_f32s(a, b), simd.add_f32s(c, d)))
}

/// Computes row *= inverse_std, then out = max(0, gain row + shift).
struct ScaleShiftRelu<'a> {
    row: &'a mut [f32],
    inverse_std: f32,
    gain: &'a [f32],
    shift: &'a [f32],
    out: &'a mut [f32],
}

impl ScaleShiftRelu<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { row, inverse_std, gain, shift, out } = self;
        let (factor, zero) = (simd.splat_f32s(inverse_std), simd.splat_f32s(0.0));
        let (row, row_tail) = S::as_mut_simd_f32s(row);
        let (gain, gain_tail) = S::as_simd_f32s(gain);
        let (shift, shift_tail) = S::as_simd_f32s(shift);
        let (out, out_tail) = S::as_mut_simd_f32s(out);
        for (((x, gain), shift), out) in row.iter_mut().zip(gain).zip(shift).zip(out) {
            *x = simd.mul_f32s(*x, factor);
            *out = simd.max_f32s(simd.mul_add_e_f32s(*gain, *x, *shift), zero);
        }
        let x = simd.mul_f32s(simd.partial_load_f32s(row_tail), factor);
        simd.partial_store_f32s(row_tail, x);
        let (gain, shift) = (simd.partial_load_f32s(gain_tail), simd.partial_load_f32s(shift_tail));
        let last = simd.max_f32s(simd.mul_add_e_f32s(gain, x, shift), zero);
        simd.partial_store_f32s(out_tail, last);
    }
}

/// Sums over a row of the scaled gradient.
struct ScaledSums {
    plain: f32,
    /// Each term multiplied by its normalised value.
    with_normalised: f32,
}

/// Computes out = gradient gain, and returns its sums.
#[inline(always)]
fn scale<S: Simd>(
    simd: S,
    gradient: &[f32],
    gain: &[f32],
    normalised: &[f32],
    out: &mut [f32],
) -> ScaledSums {
    let (gradient, gradient_tail) = S::as_simd_f32s(gradient);
    let (gain, gain_tail) = S::as_simd_f32s(gain);
    let (normalised, normalised_tail) = S::as_simd_f32s(normalised);
    let (out, out_tail) = S::as_mut_simd_f32s(out);
    let last = simd.partial_load_f32s(gradient_tail);
    let last = simd.mul_f32s(last, simd.partial_load_f32s(gain_tail));
    simd.partial_store_f32s(out_tail, last);
    let mut sum = last;
    let mut along = simd.mul_f32s(last, simd.partial_load_f32s(normalised_tail));
    for (((gradient, gain), z), out) in gradient.iter().zip(gain).zip(normalised).zip(out) {
        *out = simd.mul_f32s(*gradient, *gain);
        sum = simd.add_f32s(sum, *out);
        along = simd.mul_add_e_f32s(*out, *z, along);
    }
    ScaledSums { plain: simd.reduce_sum_f32s(sum), with_normalised: simd.reduce_sum_f32s(along) }
}

/// Computes out = inverse_std (out - mean - slope normalised).
struct Projection {
    mean: f32,
    slope: f32,
    inverse_std: f32,
}

impl Projection {
    #[inline(always)]
    fn apply<S: Simd>(self, simd: S, normalised: &[f32], out: &mut [f32]) {
        let factor = simd.splat_f32s(self.inverse_std);
        let (mean, slope) = (simd.splat_f32s(-self.mean), simd.splat_f32s(-self.slope));
        let (normalised, normalised_tail) = S::as_simd_f32s(normalised);
        let (out, out_tail) = S::as_mut_simd_f32s(out);
        for (z, out) in normalised.iter().zip(out) {
            let difference = simd.mul_add_e_f32s(slope, *z, simd.add_f32s(*out, mean));
            *out = simd.mul_f32s(factor, difference);
        }
        let last = simd.add_f32s(simd.partial_load_f32s(out_tail), mean);
        let last = simd.mul_add_e_f32s(slope, simd.partial_load_f32s(normalised_tail), last);
        simd.partial_store_f32s(out_tail, simd.mul_f32s(factor, last));
    }
}

#[cfg(test)]
mod tests;
