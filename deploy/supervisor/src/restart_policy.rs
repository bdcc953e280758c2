//! Decides whether and after which back-off a dead process is restarted.
//!
//! A process that dies soon after each start is in a crash loop, and is given up when its restart
//! budget is exhausted. Once it has worked for [`TimeLimits::proven`], its budget and its back-off
//! are reset. Otherwise a run of several weeks would lose its workers to occasional deaths.

use std::fmt::{self, Display, Formatter};
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use dmprl_run::{PANIC_STATUS, describe};

use super::children::{Running, Slot};
use super::launcher::INCARNATIONS_PER_SESSION;
use super::limits::TimeLimits;
use super::process::Process;

/// Maximum number of the evaluator's restarts without an answer in between. Then the run stops: a
/// run without evaluations is not worth its computing time.
pub(super) const EVALUATOR_RESTARTS_MAX: u32 = 3;

/// How a process ended: by itself, or killed by the supervisor for a reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Death {
    /// Verb of the message: `died`, `hung`, `was rejected` or `was killed`.
    pub verb: &'static str,
    /// Exit status, signal or reason.
    pub cause: String,
}

impl Death {
    pub(super) fn of(status: ExitStatus) -> Self {
        Self { verb: "died", cause: describe(status) }
    }

    /// The process sent no heartbeat in time.
    pub(super) fn hung(cause: String) -> Self {
        Self { verb: "hung", cause }
    }

    /// A worker that had joined does not fit the run.
    pub(super) fn rejected(cause: String) -> Self {
        Self { verb: "was rejected", cause }
    }

    /// The process exceeded a time limit.
    pub(super) fn too_slow(cause: String) -> Self {
        Self { verb: "was killed", cause }
    }
}

impl Display for Death {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} ({})", self.verb, self.cause)
    }
}

/// A restart that is due later.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Restart {
    /// Number of restarts since the budget was last reset, including this one.
    pub(super) number: u32,
    pub(super) back_off: Duration,
}

/// Schedules a restart; `None` if the process has exhausted its budget.
pub(super) fn restart(
    slot: &mut Slot,
    restarts_max: u32,
    limits: &TimeLimits,
    now: Instant,
) -> Option<Restart> {
    let has_incarnation = slot.starts < INCARNATIONS_PER_SESSION;
    if slot.restarts >= restarts_max || !has_incarnation {
        return None;
    }
    let back_off = limits.back_off(slot.restarts);
    slot.restarts += 1;
    slot.restart_at = Some(now + back_off);
    Some(Restart { number: slot.restarts, back_off })
}

/// Whether a process worked long enough for its restart budget to be reset.
///
/// A worker must have delivered segments for that long. A learner must have run that long and have
/// written a checkpoint: without one, its successor repeats all its work. The evaluator's budget is
/// reset by each answer instead.
pub(super) fn is_proven(
    process: Process,
    running: &Running,
    limits: &TimeLimits,
    now: Instant,
) -> bool {
    let Some(worked) = running.worked else { return false };
    match process {
        Process::Actor(_) => worked.last.duration_since(worked.first) >= limits.proven,
        Process::Learner | Process::Relay | Process::Gateway => {
            now.duration_since(worked.first) >= limits.proven
        }
        Process::Evaluator => false,
    }
}

/// Whether the process was killed by a signal or panicked. A process that exited by itself with an
/// error would fail again after a restart.
pub(super) fn is_crash(status: ExitStatus) -> bool {
    status.code().is_none_or(|code| code == PANIC_STATUS)
}
