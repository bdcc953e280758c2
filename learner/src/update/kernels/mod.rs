//! The arithmetic of an update on the CPU, on plain slices.
//!
//! Every product of a network's forward and backward pass reads one operand as whole vectors and
//! broadcasts single numbers of the other:
//!
//! | product                         | broadcast             | vectors                  |
//! |---------------------------------|-----------------------|--------------------------|
//! | [`Forward`]   Y = act(X Wᵀ + b) | X, by rows            | Wᵀ, in panels ([`pack`]) |
//! | [`Backward`]  dX = dY W, masked | dY, by rows           | W, copied into panels    |
//! | [`WeightGradient`] dW = Σ dYᵀ X | dY, a panel at a time | X, not copied            |
//!
//! Therefore one register tile (`tile`) computes all of them. A panel is a copy of [`PANEL`]
//! columns whose rows follow each other: in wide layers the originals would compete for the same
//! few lines of the caches. Those of Wᵀ are kept from update to update. A tile keeps its outputs in
//! registers from the first product to the last, so bias, ReLU and its mask need no pass over
//! memory. Every output is summed in a fixed order, whatever the number of threads.
//!
//! The source is generic over the vectors of `pulp` and compiled for AVX-512, AVX2 with FMA, NEON
//! and plain code. [`InstructionSet::detect`] selects one at start.

mod backward;
pub mod bf16;
mod forward;
mod layer_norm;
mod limit;
mod optimizer;
mod pack;
#[cfg(test)]
mod tests;
mod tile;
mod weight_gradient;

pub use backward::Backward;
pub use forward::{Activation, Forward};
pub(crate) use layer_norm::VARIANCE_EPSILON;
pub use layer_norm::{GainGradient, Normalise, NormaliseBackward, NormalisedShard};
pub use optimizer::{AdamPass, PolyakStep, StepSizes, adam};
pub(crate) use optimizer::{BETA1, BETA2, EPSILON};
pub use pack::{pack, packed_len};
pub use weight_gradient::{GradientShard, WeightGradient};

use std::cell::RefCell;
use std::ops::Range;

use pulp::{Arch, WithSimd};

/// Columns of a panel. A tile is one or two panels wide.
pub const PANEL: usize = 16;

/// The vector instructions that the kernels use. They affect rounding, so all threads of a run use
/// the same ones.
#[derive(Debug, Clone, Copy)]
pub struct InstructionSet(Arch);

impl InstructionSet {
    /// Returns the widest instructions of this processor.
    #[must_use]
    pub fn detect() -> Self {
        Self(Arch::new())
    }

    /// Returns all instruction sets of this processor, for tests and comparisons.
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

    /// Returns whether vectors have 16 numbers.
    fn has_avx512(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return matches!(self.0, Arch::V4(_));
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    /// Returns whether vectors have 8 numbers.
    #[cfg(target_arch = "x86_64")]
    fn has_avx2(self) -> bool {
        matches!(self.0, Arch::V3(_))
    }

    fn run<W: WithSimd>(self, work: W) -> W::Output {
        self.0.dispatch(work)
    }
}

/// Calls `f` with `len` numbers of any value, which the thread keeps for the next call.
fn with_scratch<T>(len: usize, f: impl FnOnce(&mut [f32]) -> T) -> T {
    thread_local! {
        static SCRATCH: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
    }
    SCRATCH.with_borrow_mut(|scratch| {
        if scratch.len() < len {
            scratch.resize(len, 0.0);
        }
        f(&mut scratch[..len])
    })
}

/// Copies `columns` of every row into a row of the panel. No result may depend on its other
/// columns.
#[inline(always)]
fn fill_panel<'a>(rows: impl Iterator<Item = &'a [f32]>, columns: Range<usize>, panel: &mut [f32]) {
    for (row, copy) in rows.zip(panel.chunks_exact_mut(PANEL)) {
        match <&[f32; PANEL]>::try_from(&row[columns.clone()]) {
            Ok(whole) => copy.copy_from_slice(whole),
            Err(_) => copy[..columns.len()].copy_from_slice(&row[columns.clone()]),
        }
    }
}
