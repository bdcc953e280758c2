//! Names of a run's processes.

use std::fmt::{self, Display, Formatter};

/// A process that the supervisor starts or admits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Process {
    /// The learner.
    Learner,
    /// Acts as the learner on a host without one.
    Relay,
    /// A worker, by its index.
    Actor(u32),
    /// The evaluator.
    Evaluator,
    /// Acts as the workers of other hosts.
    Gateway,
}

impl Process {
    /// Whether the process is a worker.
    #[must_use]
    pub fn is_worker(self) -> bool {
        matches!(self, Self::Actor(_))
    }
}

impl Display for Process {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Learner => formatter.write_str("learner"),
            Self::Relay => formatter.write_str("relay"),
            Self::Gateway => formatter.write_str("gateway"),
            Self::Actor(index) => write!(formatter, "actor-{index}"),
            Self::Evaluator => formatter.write_str("evaluator"),
        }
    }
}
