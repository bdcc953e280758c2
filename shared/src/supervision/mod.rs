//! The interface between a process and its supervisor.
//!
//! The loops in `actors` and `learner` use their supervisor through the trait [`Supervisor`]. In
//! production the control pipe implements it, with one JSON object per line. In tests
//! [`FakeSupervisor`] implements it, so that a loop runs without a process of its own.

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

/// Why a report was not delivered, usually because the supervisor is gone.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct ReportError(#[from] pub Box<dyn Error + Send + Sync>);

/// Counts of the whole run, over all processes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RunTotals {
    /// Failures of environments.
    pub env_failures: u64,
    /// State of the workers.
    pub workers: WorkersNow,
    /// Counts of segments that workers have produced and sent and that the learner has
    /// acknowledged.
    pub sent: Sent,
}

/// A process's connection to its supervisor.
///
/// No method blocks, except [`Supervisor::next_command`], and none allocates, except those that
/// send a report.
pub trait Supervisor {
    /// A flag that is set when the process must finish and exit, either on a stop command or
    /// because the supervisor is gone.
    fn stop_flag(&self) -> &AtomicBool;

    /// Whether the process must finish and exit.
    fn stop_requested(&self) -> bool {
        self.stop_flag().load(Ordering::Acquire)
    }

    /// Whether the run must end as it does after its last step.
    fn finish_requested(&self) -> bool;

    /// Whether the supervisor is gone. If so, reports fail and a stop is requested.
    fn is_gone(&self) -> bool;

    /// Waits up to `wait` for the next command and returns it. Commands that other methods expose
    /// (stop, finish and totals) are not returned.
    fn next_command(&self, wait: Duration) -> Option<Command>;

    /// Returns the latest totals; all zero until the supervisor has sent some.
    fn totals(&self) -> RunTotals;

    /// Records that the loop has completed an iteration. A loop without a heartbeat for too long is
    /// considered hung.
    fn heartbeat(&self, doing: Activity);

    /// Records the number of unacknowledged segments, which is sent with each heartbeat.
    fn note_unacknowledged(&self, segments: usize);

    /// Sends a report.
    ///
    /// # Errors
    /// If the supervisor is gone.
    fn report(&self, report: &Report) -> Result<(), ReportError>;

    /// Sends a warning, which the supervisor shows to the user. Errors are ignored: if the
    /// supervisor is gone, a stop is requested as well.
    fn warn(&self, message: String) {
        let _ = self.report(&Report::Warning { message });
    }
}
