//! What can go wrong between Rust and Python.

use std::path::PathBuf;

use dmprl_shared::spec::SpecError;
use pyo3::{prelude::*, types::PyTracebackMethods};
use thiserror::Error;

/// Lines of a traceback that are kept: the innermost frames and the exception's own line.
const TRACEBACK_LINES_MAX: usize = 12;

/// Why the interpreter or an environment could not do what was asked.
#[derive(Debug, Error)]
pub enum PythonError {
    /// `.venv` has no interpreter.
    #[error("{} does not exist; it is made by the first `train`", executable.display())]
    NoVenv {
        /// The interpreter that was looked for.
        executable: PathBuf,
    },
    /// The libpython that was loaded is not the linked one.
    #[error(
        "this program was built for Python {expected} but loaded Python {got}. Is LD_LIBRARY_PATH \
         set? If the Python of this machine was upgraded, build again"
    )]
    OtherVersion {
        /// `sys.version` of the linked Python.
        expected: String,
        /// `sys.version` of the loaded one.
        got: String,
    },
    /// `.venv` belongs to another installation than the linked one.
    #[error(
        "{} was made by the Python in {got}, but this program is linked against the one in \
         {expected}; remove it and start again", venv.display()
    )]
    OtherInstallation {
        /// The virtual environment.
        venv: PathBuf,
        /// `sys.base_prefix` of the linked Python.
        expected: String,
        /// `sys.base_prefix` as found.
        got: String,
    },
    /// CPython refused to start.
    #[error("Python does not start ({function}): {message}")]
    Initialise {
        /// Which function of CPython said so; empty when it does not say.
        function: String,
        /// Its message.
        message: String,
    },
    /// A process has one interpreter, and it runs with other options.
    #[error("Python already runs in this process with {running}; asked for {asked}")]
    AlreadyStarted {
        /// Options it was started with.
        running: String,
        /// Options now asked for.
        asked: String,
    },
    /// A path that cannot be handed to Python.
    #[error("{} cannot be a Python path: {reason}", path.display())]
    Path {
        /// The path.
        path: PathBuf,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// Python code raised.
    #[error("{kind}: {message}{}", indented(traceback))]
    Exception {
        /// The exception's type.
        kind: String,
        /// Its message; for a failing environment its id, its index and the step.
        message: String,
        /// The last lines of the traceback.
        traceback: Vec<String>,
    },
    /// The environment's sizes or bounds cannot be used.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// An argument has another length than the environments need.
    #[error("{task_id}: {name} has {got} entries, expected {expected}")]
    Length {
        /// Task.
        task_id: String,
        /// Which argument or buffer.
        name: &'static str,
        /// Length it must have.
        expected: usize,
        /// Length it has.
        got: usize,
    },
    /// A policy that has diverged: MuJoCo would silently reset its state.
    #[error("{task_id}, environment {env_index}, step {step} of the segment: action is {value}")]
    ActionNotFinite {
        /// Task.
        task_id: String,
        /// Which environment.
        env_index: usize,
        /// Which step.
        step: usize,
        /// The value.
        value: f64,
    },
    /// An environment that nothing is left to be done about: it was reset.
    #[error(
        "{task_id}, environment {env}, reset: {name} is {value}, which is no finite 32-bit number"
    )]
    ObservationNotFinite {
        /// Task.
        task_id: String,
        /// Which environment.
        env: usize,
        /// Which entry of the observation.
        name: String,
        /// The value.
        value: f64,
    },
    /// The environment cannot say what a goal would have been rewarded with.
    #[error(
        "{task_id}: compute_reward returned {value} for goals that an episode reached; expected a \
         finite 32-bit number"
    )]
    GoalRewardNotFinite {
        /// Task.
        task_id: String,
        /// The value.
        value: f64,
    },
    /// Hindsight cannot be had here.
    #[error(
        "replay.hindsight needs a goal-conditioned environment: {reason}. Its observation must be \
         a Dict with two Boxes of one shape, achieved_goal and desired_goal, its method \
         compute_reward(achieved_goal, desired_goal, info) must take many goals at once, and its \
         episodes must have a time limit; without those, train with replay.hindsight = \"none\""
    )]
    NoGoals {
        /// What is missing, in the environment's words.
        reason: String,
    },
    /// The package `dmprl` in `.venv` does not fit this program.
    #[error("{task_id}: {name} of the Python package dmprl: {reason}")]
    Interface {
        /// Task.
        task_id: String,
        /// Which attribute.
        name: &'static str,
        /// What is wrong with it.
        reason: String,
    },
}

impl PythonError {
    /// Takes an exception apart while Python is at hand; the result needs no interpreter.
    pub(super) fn exception(py: Python<'_>, error: &PyErr) -> Self {
        let kind = error.get_type(py).name().map_or_else(|_| "exception".into(), |n| n.to_string());
        let message = error.value(py).str().map_or_else(|_| String::new(), |m| m.to_string());
        Self::Exception { kind, message, traceback: traceback_end(py, error) }
    }
}

/// The last frames of an exception and, before them, of the one that caused it: the cause is the
/// line in the user's environment.
fn traceback_end(py: Python<'_>, error: &PyErr) -> Vec<String> {
    let cause = error.cause(py);
    let innermost = cause.as_ref().unwrap_or(error);
    let Some(traceback) = innermost.traceback(py) else { return Vec::new() };
    let text = PyTracebackMethods::format(&traceback).unwrap_or_default();
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    lines.push(innermost.to_string());
    lines.split_off(lines.len().saturating_sub(TRACEBACK_LINES_MAX))
}

fn indented(lines: &[String]) -> String {
    lines.iter().map(|line| format!("\n    {line}")).collect()
}
