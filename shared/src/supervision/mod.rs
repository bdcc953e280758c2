//! How a process talks to its supervisor.
//!
//! The loops in `actors` and `learner` know their supervisor only through the trait [`Supervisor`].
//! In the program the control pipe implements it, one JSON object a line; [`FakeSupervisor`]
//! implements it for tests, which run a loop without starting a process.

mod fake;
mod messages;

use std::error::Error;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

pub use fake::FakeSupervisor;
pub use messages::{
    Activity, Command, EvaluationNotFinite, EvaluationRequest, EvaluationRow, HostNow, Progress,
    Report, WorkersNow,
};

use crate::transport::delivery::Sent;

/// Why a report was not delivered; as a rule, the supervisor is gone.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct ReportError(#[from] pub Box<dyn Error + Send + Sync>);

/// What the supervisor has counted in the whole run, all processes together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RunTotals {
    /// Failures of environments.
    pub env_failures: u64,
    /// How many workers there are, and how they fare.
    pub workers: WorkersNow,
    /// Segments that workers have produced, sent and had acknowledged.
    pub sent: Sent,
}

/// A process's end of the conversation with its supervisor. No method waits, except
/// [`Supervisor::next_command`], and none allocates, except those that send a report.
pub trait Supervisor {
    /// Set once the process must finish and exit: on a stop command, or because the supervisor is
    /// gone.
    fn stop_flag(&self) -> &AtomicBool;

    /// Whether the process must finish and exit.
    fn stop_requested(&self) -> bool {
        self.stop_flag().load(Ordering::Acquire)
    }

    /// Whether the run must end as if it had all its steps.
    fn finish_requested(&self) -> bool;

    /// Whether the supervisor is gone. Nobody receives reports any more, and a stop is requested.
    fn is_gone(&self) -> bool;

    /// Waits up to `wait` for the next command and returns it. Stop, finish and totals are no
    /// commands here: each has a method of its own.
    fn next_command(&self, wait: Duration) -> Option<Command>;

    /// The newest totals; all zero before the supervisor has sent any.
    fn totals(&self) -> RunTotals;

    /// Records that the loop has completed another round. A loop that completes none for too long
    /// counts as hanging.
    fn heartbeat(&self, doing: Activity);

    /// Records how many segments the learner has not acknowledged; sent along with heartbeats.
    fn note_unacknowledged(&self, segments: usize);

    /// Sends a report.
    ///
    /// # Errors
    /// The supervisor is gone.
    fn report(&self, report: &Report) -> Result<(), ReportError>;

    /// Sends a warning, which the supervisor shows to the user. Does nothing if the supervisor is
    /// gone: the loop notices that as a stop.
    fn warn(&self, message: String) {
        let _ = self.report(&Report::Warning { message });
    }
}
