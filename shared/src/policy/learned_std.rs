//! The distribution that a stochastic policy draws its actions from: one Gaussian whose logarithmic
//! standard deviation is learned and does not depend on the state (Schulman et al. 2017, section
//! 6.1; Neural Dynamic Policies), the same for all K steps of a segment.
//!
//! The A logarithms stand behind the network's parameters in the policy's flat ones. A draw is not
//! bounded: the segment keeps it as it is, since its probability is what is learned from, and the
//! environment gets it clipped to the action's bounds.

use crate::config::{AlgorithmName, ExperimentConfig};
use crate::spec::EnvSpec;

/// Where the logarithms stand, and how they begin.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnedStd {
    dims: usize,
    initial_log_std: f32,
}

impl LearnedStd {
    /// The one that the algorithm asks for, if it does.
    pub(super) fn of(config: &ExperimentConfig, spec: &EnvSpec) -> Option<Self> {
        (config.algorithm.name == AlgorithmName::Ndp).then_some(Self {
            dims: spec.action_len,
            initial_log_std: config.algorithm.ndp.initial_log_std as f32,
        })
    }

    /// A, the number of its parameters.
    #[must_use]
    #[expect(clippy::len_without_is_empty, reason = "an action has at least one dimension")]
    pub fn len(&self) -> usize {
        self.dims
    }

    pub(super) fn initial(&self) -> f32 {
        self.initial_log_std
    }

    /// The logarithms, (A,), of a policy's flat parameters, (P,).
    ///
    /// # Panics
    /// If there are fewer parameters than logarithms.
    #[must_use]
    pub fn log_std<'a>(&self, parameters: &'a [f32]) -> &'a [f32] {
        &parameters[parameters.len() - self.dims..]
    }
}
