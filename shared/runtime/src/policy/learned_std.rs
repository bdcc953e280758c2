//! Action distribution of a stochastic policy: a Gaussian with a learned, state-independent
//! logarithmic standard deviation.
//!
//! It is the same for all K steps of a segment (Schulman et al. 2017, section 6.1; Neural Dynamic
//! Policies). In the policy's flat parameters, the A logarithms follow the network's parameters.
//! Draws are not bounded. Segments contain the unclipped draw, because learning needs its
//! probability. The environment receives it clipped to the action's bounds.

use super::PolicyDescription;
use crate::config::AlgorithmName;

/// Position of the logarithms.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnedStd {
    dims: usize,
}

impl LearnedStd {
    /// Creates the distribution, or `None` if the algorithm does not use it.
    pub(super) fn of(description: &PolicyDescription) -> Option<Self> {
        let dims = description.spec.action_len;
        (description.algorithm == AlgorithmName::Ndp).then_some(Self { dims })
    }

    /// Number of parameters, A.
    #[must_use]
    #[expect(clippy::len_without_is_empty, reason = "an action has at least one dimension")]
    pub fn len(&self) -> usize {
        self.dims
    }

    /// Returns the logarithms, (A,), of a policy's flat parameters, (P,).
    ///
    /// # Panics
    /// If there are fewer parameters than logarithms.
    #[must_use]
    pub fn log_std<'a>(&self, parameters: &'a [f32]) -> &'a [f32] {
        &parameters[parameters.len() - self.dims..]
    }
}
