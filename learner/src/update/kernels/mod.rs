//! The arithmetic of an update on the CPU, on plain slices.
//!
//! Every product of a network's forward and backward pass has one wide operand that is read as
//! whole vectors and one of which single numbers are broadcast:
//!
//! | product                           | broadcast   | vectors                      |
//! |-----------------------------------|-------------|------------------------------|
//! | [`Forward`]   Y = act(X Wᵀ + b)   | X, by rows  | Wᵀ, in panels ([`pack`])     |
//! | [`Backward`]  dX = dY W, masked   | dY, by rows | W as it stands               |
//! | [`WeightGradient`] dW = Σ dYᵀ X   | dY, by columns | X as it stands            |
//!
//! so one register tile (`tile`) does them all, and the panels of Wᵀ are the only copy. A tile
//! holds its outputs from the first product to the last: bias, ReLU and its mask cost no pass over
//! memory, and every output is a sum in a fixed order whatever the number of threads.
//!
//! The source is generic over the vectors of `pulp` and compiled for each instruction set that
//! matters (AVX-512, AVX2 with FMA, NEON, plain); [`InstructionSet::detect`] picks at start.

mod backward;
pub mod bf16;
mod forward;
mod layer_norm;
mod optimizer;
mod pack;
#[cfg(test)]
mod tests;
mod tile;
mod weight_gradient;

pub use backward::Backward;
pub use forward::{Activation, Forward};
pub(crate) use layer_norm::VARIANCE_EPSILON;
pub use layer_norm::{GainGradient, Normalise, NormaliseBackward, NormalisedBlock};
pub use optimizer::{AdamPass, Follow, StepSizes, adam, polyak};
pub(crate) use optimizer::{BETA1, BETA2, EPSILON};
pub use pack::{pack, packed_len};
pub use weight_gradient::{GradientBlock, WeightGradient};

use pulp::{Arch, WithSimd};

/// Outputs of a layer that stand side by side in a packed panel, and the width of every tile.
pub const PANEL: usize = 16;

/// The vector instructions that the kernels use. The choice changes results by rounding, so all
/// threads of a run use the same.
#[derive(Debug, Clone, Copy)]
pub struct InstructionSet(Arch);

impl InstructionSet {
    /// The best that this processor has.
    #[must_use]
    pub fn detect() -> Self {
        Self(Arch::new())
    }

    /// All that this processor has, for tests and comparisons.
    #[must_use]
    pub fn all() -> Vec<Self> {
        let mut all = vec![Self(Arch::Scalar)];
        #[cfg(target_arch = "x86_64")]
        {
            all.extend(pulp::x86::V3::try_new().map(|simd| Self(Arch::V3(simd))));
            all.extend(pulp::x86::V4::try_new().map(|simd| Self(Arch::V4(simd))));
        }
        #[cfg(target_arch = "aarch64")]
        all.extend(pulp::aarch64::Neon::try_new().map(|simd| Self(Arch::Neon(simd))));
        all
    }

    /// Whether vectors of 16 numbers are at hand.
    fn has_avx512(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return matches!(self.0, Arch::V4(_));
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    fn run<W: WithSimd>(self, work: W) -> W::Output {
        self.0.dispatch(work)
    }
}
