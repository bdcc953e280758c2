//! The highest rate of the processor, for comparisons.

use std::hint::black_box;

use pulp::{Simd, WithSimd};

use super::InstructionSet;

/// Independent sums. More than any processor needs to have its units busy, and few enough to stay
/// in registers.
const CHAINS: usize = 12;

/// Multiplies and adds on registers only. No product of matrices is faster.
struct Chains {
    rounds: usize,
}

impl WithSimd for Chains {
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> usize {
        let (factor, term) = (simd.splat_f32s(black_box(0.5)), simd.splat_f32s(black_box(0.1)));
        let mut sums = [simd.splat_f32s(0.0); CHAINS];
        for _ in 0..self.rounds {
            for sum in &mut sums {
                *sum = simd.mul_add_f32s(*sum, factor, term);
            }
        }
        black_box(sums.into_iter().map(|sum| simd.reduce_sum_f32s(sum)).sum::<f32>());
        2 * CHAINS * self.rounds * S::F32_LANES
    }
}

impl InstructionSet {
    /// Does as many multiplications and additions per second as one core can. Returns their number.
    #[must_use]
    pub fn saturate(self, rounds: usize) -> usize {
        self.run(Chains { rounds })
    }
}
