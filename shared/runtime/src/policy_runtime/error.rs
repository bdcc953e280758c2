//! Errors of the runtime.

use thiserror::Error;

use super::safety::HOLD_STEPS_MAX;
use crate::policy::HoldError;
use crate::policy_file::PolicyFileError;

/// Why the runtime returns no action.
#[derive(Debug, Error)]
pub enum RuntimeError {
    /// The policy file cannot be used.
    #[error(transparent)]
    File(#[from] PolicyFileError),
    /// An observation of the wrong length.
    #[error("the observation has {got} numbers, expected {expected}")]
    Length {
        /// Length O of the environment's observations.
        expected: usize,
        /// Actual length.
        got: usize,
    },
    /// An observation with a value that is not finite.
    #[error("observation[{index}], {name}, is {value}: expected a finite number")]
    NotFinite {
        /// Index of the entry.
        index: usize,
        /// Name of the entry.
        name: String,
        /// Its value.
        value: f64,
    },
    /// The network's outputs are NaN.
    #[error(
        "the policy's action for this observation is not finite: the observation is far outside \
         the training data"
    )]
    Decision,
    /// The given start is invalid for this policy.
    #[error("this policy cannot start at the given y0: {reason}")]
    Start {
        /// The reason.
        reason: String,
    },
    /// A robot cannot be held, because its hold is not known.
    #[error(
        "the policy states no hold, the command that holds the robot: state it with `dmprl export \
         --hold` or with Safety::set_hold before any limit, as zero-velocity, zero-torque or the \
         position to keep"
    )]
    NoHold,
    /// The given hold is invalid for this policy.
    #[error(transparent)]
    Hold(#[from] HoldError),
    /// The hold was not reached.
    #[error("the hold was not reached in {HOLD_STEPS_MAX} control steps")]
    HoldNotReached,
    /// An invalid deadline.
    #[error("the deadline is {got} s: expected a positive number")]
    Deadline {
        /// The value \[s\].
        got: f64,
    },
    /// An invalid limit.
    #[error("{what} of action dimension {dimension} is {got}: expected {expected}")]
    Limit {
        /// Name of the limit.
        what: &'static str,
        /// Index of the action dimension.
        dimension: usize,
        /// Expected value.
        expected: String,
        /// Actual value.
        got: String,
    },
}

impl RuntimeError {
    pub(super) fn start(reason: &str) -> Self {
        Self::Start { reason: reason.to_owned() }
    }
}
