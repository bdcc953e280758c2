//! How the supervisor reports a run: it draws and writes nothing itself.

use std::path::PathBuf;

use crate::control::{EvaluationRow, Progress};

/// Receives the events of a run in order, on the supervisor's thread: a slow observer delays it.
pub trait RunObserver {
    /// Handles an event.
    fn on_event(&mut self, event: RunEvent);

    /// Whether the observer shows the processes, whose states are computed only then.
    fn shows_processes(&self) -> bool {
        false
    }
}

/// An event of a run.
#[derive(Debug, Clone, PartialEq)]
pub enum RunEvent {
    /// The session begins.
    Started {
        /// Task, algorithm, seed and workers in one line.
        title: String,
        /// Run directory.
        run: PathBuf,
        /// Endpoint of the learner, if it is on another host.
        learner: Option<String>,
        /// Evaluations of earlier sessions, oldest first.
        evaluations: Vec<EvaluationRow>,
    },
    /// The learner has returned to a checkpoint; these evaluations precede it.
    Rewound {
        /// Oldest first.
        evaluations: Vec<EvaluationRow>,
    },
    /// The user should read this.
    Message(String),
    /// The learner has reported its progress.
    Progress {
        /// The report.
        progress: Progress,
        /// States of all processes, if the observer shows them.
        processes: Vec<ProcessLine>,
    },
    /// States of all processes, between two reports of progress.
    Processes(Vec<ProcessLine>),
    /// An evaluation is complete.
    Evaluated {
        /// Its row in `evaluations.jsonl`.
        row: EvaluationRow,
        /// Whether it is the best of the run so far.
        is_best: bool,
    },
    /// All processes have ended.
    Ended,
}

/// A process of the run, as seen by the supervisor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProcessLine {
    /// Name, such as `learner` or `actor-0`.
    pub name: String,
    /// Short description of its activity.
    pub state: String,
    /// Number of restarts.
    pub restarts: u32,
}
