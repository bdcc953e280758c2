//! What the runtime refuses.

use thiserror::Error;

use crate::policy_file::PolicyFileError;

/// Why there is no action.
#[derive(Debug, Error)]
pub enum RuntimeError {
    /// The policy's file.
    #[error(transparent)]
    File(#[from] PolicyFileError),
    /// An observation of another length.
    #[error("an observation of {got} numbers, expected {expected}")]
    Length {
        /// Length O of the environment's observations.
        expected: usize,
        /// Length offered.
        got: usize,
    },
    /// An observation that is none.
    #[error("observation[{index}], {name}, is {value}: expected a finite number")]
    NotFinite {
        /// Which entry.
        index: usize,
        /// What it is called.
        name: String,
        /// Its value.
        value: f64,
    },
    /// The network's outputs are no numbers.
    #[error(
        "the policy makes no finite action of this observation: it is far beyond what it was \
         trained on"
    )]
    Decision,
    /// A start that the policy cannot begin at.
    #[error("this policy cannot begin at that y0: {reason}")]
    Start {
        /// Why not.
        reason: String,
    },
    /// A limit that is none.
    #[error("{what} of action dimension {dimension} is {got}: expected {expected}")]
    Limit {
        /// Which limit.
        what: &'static str,
        /// Which action dimension.
        dimension: usize,
        /// What fits.
        expected: String,
        /// What was offered.
        got: String,
    },
}

impl RuntimeError {
    pub(super) fn start(reason: &str) -> Self {
        Self::Start { reason: reason.to_owned() }
    }
}
