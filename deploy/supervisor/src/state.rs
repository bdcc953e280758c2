//! Parts of the supervisor's state.

use std::time::{Duration, Instant};

use dmprl_control::Progress;
use dmprl_run::RunDirectory;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::spec::EnvSpec;

use super::limits::TimeLimits;
use super::process::Process;
use super::totals::Totals;

/// Constants of a session.
#[derive(Debug)]
pub(super) struct Settings {
    pub(super) config: ExperimentConfig,
    pub(super) limits: TimeLimits,
    /// The process to which workers send: the learner, or the relay on a host without one.
    pub(super) hub: Process,
    /// Learner, worker and evaluator are one process.
    pub(super) one_process: bool,
    /// How long the learner's host may be unreachable, on a host without a learner.
    pub(super) patience: Option<Duration>,
    /// For the paths of logs.
    pub(super) run: RunDirectory,
    /// Counts of earlier sessions.
    pub(super) earlier: Totals,
    /// The environment, if an earlier session has determined it.
    pub(super) spec: Option<EnvSpec>,
}

/// Stage of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Phase {
    /// Starting and learning.
    Training,
    /// The learner was asked to finish.
    Draining { deadline: Instant },
    /// The learner has finished and is exiting, or evaluations are outstanding.
    Finishing { deadline: Instant },
    /// All processes were asked to stop, and were killed later if `killed`.
    Stopping { deadline: Instant, killed: bool },
}

/// State of the learner, or of the relay on a host without one.
#[derive(Debug, Default)]
pub(super) struct Learner {
    pub(super) ready: bool,
    /// Time of the last learner's death, until its successor receives a segment.
    pub(super) died: Option<Instant>,
    /// The evaluator was killed with its learner and has not exited; the successor waits for it.
    pub(super) waits_for_evaluator: bool,
    /// The learner has finished and written its last checkpoint.
    pub(super) finished: bool,
    /// A checkpoint was written after the newest progress.
    pub(super) checkpointed: bool,
}

/// A report of progress and its time.
#[derive(Debug)]
pub(super) struct Milestone {
    pub(super) at: Instant,
    pub(super) progress: Progress,
}
