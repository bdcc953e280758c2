//! The error with which a learner stops.

use dmprl_shared::policy::PolicyError;
use thiserror::Error;

use crate::algorithms::NoWindow;
use crate::demonstrations::DemonstrationError;
use crate::finite::NotFiniteParameter;

/// Why the learner stopped.
#[derive(Debug, Error)]
pub enum LearnerError {
    /// The policy cannot be built.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// A tensor operation failed.
    #[error("tensor operation: {0}")]
    Tensor(#[from] candle_core::Error),
    /// The replay has no window to learn from.
    #[error(transparent)]
    NoWindow(#[from] NoWindow),
    /// The demonstrations do not fit the run.
    #[error(transparent)]
    Demonstrations(#[from] DemonstrationError),
    /// A parameter of the policy is NaN or infinite.
    #[error(
        "update {update}: {source}; the run has diverged. The last checkpoint is valid: lower \
         algorithm.actor_learning_rate, algorithm.critic_learning_rate or \
         pacing.updates_per_segment"
    )]
    NotFiniteParameter {
        /// Number of the update.
        update: u64,
        /// The parameter.
        source: NotFiniteParameter,
    },
    /// A loss is NaN or infinite.
    #[error(
        "update {update}: {name} is {value}; the run has diverged. The last checkpoint is valid: \
         lower algorithm.critic_learning_rate or pacing.updates_per_segment"
    )]
    NotFinite {
        /// Number of the update.
        update: u64,
        /// Name of the quantity.
        name: &'static str,
        /// Its value.
        value: f32,
    },
}
