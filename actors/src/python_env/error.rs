//! Errors of the interpreter and the environments.

use std::path::PathBuf;

use dmprl_shared::spec::SpecError;
use pyo3::{prelude::*, types::PyTracebackMethods};
use thiserror::Error;

/// Maximum number of lines of a traceback: the innermost frames and the exception's own line.
const TRACEBACK_LINES_MAX: usize = 12;

/// Why the interpreter or an environment failed.
#[derive(Debug, Error)]
pub enum PythonError {
    /// `.venv` has no interpreter.
    #[error("{} does not exist; the first `train` creates it", executable.display())]
    NoVenv {
        /// Expected path of the interpreter.
        executable: PathBuf,
    },
    /// The loaded libpython is not the linked one.
    #[error(
        "this program was built for Python {expected}, but loaded Python {got}. Unset \
         LD_LIBRARY_PATH if it is set; if this machine's Python was upgraded, build again"
    )]
    OtherVersion {
        /// `sys.version` of the linked Python.
        expected: String,
        /// `sys.version` of the loaded one.
        got: String,
    },
    /// `.venv` belongs to another installation than the linked libpython.
    #[error(
        "{} was created by the Python in {got}, but this program is linked against the one in \
         {expected}; remove it and start again", venv.display()
    )]
    OtherInstallation {
        /// The virtual environment.
        venv: PathBuf,
        /// `sys.base_prefix` of the linked Python.
        expected: String,
        /// `sys.base_prefix` of the virtual environment.
        got: String,
    },
    /// CPython could not be initialised.
    #[error("cannot start Python ({function}): {message}")]
    Initialise {
        /// Function of CPython that failed; empty if unknown.
        function: String,
        /// CPython's message.
        message: String,
    },
    /// The only interpreter of this process is running with other options.
    #[error("Python is already running in this process with {running}; requested {asked}")]
    AlreadyStarted {
        /// Options of the running interpreter.
        running: String,
        /// Requested options.
        asked: String,
    },
    /// A path cannot be passed to Python.
    #[error("{} cannot be a Python path: {reason}", path.display())]
    Path {
        /// The path.
        path: PathBuf,
        /// The reason.
        reason: &'static str,
    },
    /// Python code raised an exception.
    #[error("{kind}: {message}{}", indented(traceback))]
    Exception {
        /// The exception's type.
        kind: String,
        /// Its message; for a failed environment with id, index and step.
        message: String,
        /// The last lines of the traceback.
        traceback: Vec<String>,
    },
    /// The environment's sizes or bounds are unusable.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// An argument or buffer has the wrong length.
    #[error("{task_id}: {name} has {got} entries, expected {expected}")]
    Length {
        /// Task.
        task_id: String,
        /// Name of the argument or buffer.
        name: &'static str,
        /// Required length.
        expected: usize,
        /// Actual length.
        got: usize,
    },
    /// An action is not finite, because the policy has diverged. MuJoCo would silently reset its
    /// state.
    #[error("{task_id}, environment {env_index}, step {step} of the segment: action is {value}")]
    ActionNotFinite {
        /// Task.
        task_id: String,
        /// Index of the environment.
        env_index: usize,
        /// Step of the segment.
        step: usize,
        /// The value.
        value: f64,
    },
    /// An observation is not finite after a reset.
    #[error(
        "{task_id}, environment {env}, reset: {name} is {value}, expected a finite 32-bit number"
    )]
    ObservationNotFinite {
        /// Task.
        task_id: String,
        /// Index of the environment.
        env: usize,
        /// Name of the entry of the observation.
        name: String,
        /// The value.
        value: f64,
    },
    /// The environment returned a reward for another goal that is not finite.
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
    /// The environment does not support hindsight.
    #[error(
        "replay.hindsight needs a goal-conditioned environment: {reason}. Its observation must be \
         a Dict with two Boxes of one shape, achieved_goal and desired_goal, its method \
         compute_reward(achieved_goal, desired_goal, info) must accept many goals at once, and \
         its episodes must have a time limit. Otherwise set replay.hindsight = \"none\""
    )]
    NoGoals {
        /// The environment's message.
        reason: String,
    },
    /// The package `dmprl` in `.venv`, or a user's `SegmentEnv`, does not match this program.
    #[error("{task_id}: {name} of the Python package dmprl: {reason}")]
    Interface {
        /// Task.
        task_id: String,
        /// Name of the attribute.
        name: &'static str,
        /// The reason.
        reason: String,
    },
}

impl PythonError {
    /// Converts an exception. The result can be used without the interpreter.
    pub(super) fn exception(py: Python<'_>, error: &PyErr) -> Self {
        let kind = error.get_type(py).name().map_or_else(|_| "exception".into(), |n| n.to_string());
        let message = error.value(py).str().map_or_else(|_| String::new(), |m| m.to_string());
        Self::Exception { kind, message, traceback: traceback_end(py, error) }
    }
}

/// Returns the last lines of a traceback: that of the exception's cause, if it has one, because the
/// cause is in the user's environment.
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
