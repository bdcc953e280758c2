//! Input and output of the state machine: events, actions, and the failure of a run.

use std::path::PathBuf;
use std::process::ExitStatus;
use std::time::Duration;

use anyhow::{Error, anyhow};
use dmprl_control::{Command, Greeting, Report};
use dmprl_shared::spec::EnvSpec;

use super::observer::RunEvent;
use super::process::Process;

/// Something that happened to the run.
#[derive(Debug)]
pub(super) enum Event {
    /// The session begins.
    Begin,
    /// A process sent a report.
    Report(Process, Report),
    /// A process wrote a line that is not a report.
    Garbage(Process, String),
    /// A child exited, and all its reports have been handled.
    Exited(Process, ExitStatus),
    /// A worker that had joined exited. Only its parent knows its exit status.
    Gone(Process),
    /// A worker asks to join.
    JoinRequested {
        /// Identifies the request in the answer.
        request: u64,
        /// Process id of the worker.
        id: i32,
        /// Version of the worker's program.
        speaks: Greeting,
    },
    /// A process could not be started or admitted.
    StartFailed(Process, Error),
    /// An action failed without which the run cannot continue.
    ActionFailed(Error),
    /// The run's shared-memory directory was removed.
    DomainLost(PathBuf),
    /// Another process, described here, has taken the run over.
    LockLost(String),
    /// The user interrupts.
    Interrupt,
    /// The supervisor itself was late, so a child's silence since its last turn does not count.
    Late,
    /// The supervisor itself was suspended for this time, by Ctrl-Z or a paused container.
    Suspended(Duration),
    /// Time has passed.
    Tick {
        /// Whether all reports that had arrived were handled. Silence counts only in this case.
        all_heard: bool,
    },
}

/// An action that the supervisor performs for the state machine.
#[derive(Debug)]
pub(super) enum Action {
    /// Starts a process.
    Start {
        process: Process,
        /// Number of the start in this session, from 0.
        start: u32,
        /// Set for a learner that replaces a dead one. It starts from the newest checkpoint, or
        /// from the beginning if there is none.
        successor: Option<Successor>,
    },
    /// Sends the path of the shared memory to a worker.
    Attach(Process),
    /// Sends a command without waiting.
    Send(Process, Command),
    /// Sends SIGKILL; the exit arrives as an event.
    Kill(Process),
    /// Opens the socket for workers that join.
    Listen,
    /// Admits a worker.
    Admit(Admission),
    /// Rejects a worker that asks to join.
    Refuse { request: u64, reason: String },
    /// Writes the environment's description into the run directory.
    WriteSpec(EnvSpec),
    /// Reads the evaluations again after a restarted learner has cut them back to its checkpoint.
    Rewind,
    /// Passes an event to the observer.
    Notify(RunEvent),
    /// Reports a failure to the observer while the run is already stopping.
    NotifyFailure(Failure),
}

/// A learner that replaces a dead one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Successor {
    /// Restarts of the learner in the whole run, including this one.
    pub(super) restarts: u64,
}

/// The place of a worker that joins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Admission {
    pub(super) request: u64,
    /// Index of the worker.
    pub(super) index: u32,
    /// Number of its start in this session, from 0.
    pub(super) start: u32,
    /// Number of workers, including this one.
    pub(super) workers: usize,
}

/// An error that ends the run.
#[derive(Debug)]
pub(super) struct Failure {
    pub(super) error: Error,
    /// Process whose last log lines follow the error.
    pub(super) log: Option<Process>,
    pub(super) advice: ResumeAdvice,
    /// Consequence for the run, shown before the error.
    pub(super) context: Option<&'static str>,
}

/// Whether the error message suggests to resume the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ResumeAdvice {
    /// A resumed run would fail for the same reason.
    Never,
    /// A run without a checkpoint would start over and fail in the same way.
    IfCheckpoint,
    /// The learner is running, and writes a checkpoint when the run stops.
    Always,
}

impl Failure {
    pub(super) fn new(message: String) -> Self {
        anyhow!(message).into()
    }

    pub(super) fn log(self, process: Process) -> Self {
        Self { log: Some(process), ..self }
    }

    pub(super) fn advice(self, advice: ResumeAdvice) -> Self {
        Self { advice, ..self }
    }

    pub(super) fn context(self, context: &'static str) -> Self {
        Self { context: Some(context), ..self }
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        Self { error, log: None, advice: ResumeAdvice::Never, context: None }
    }
}
