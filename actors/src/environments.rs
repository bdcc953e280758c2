//! Stage 3 of 8: creates the environments of a process, watches calls into them and reports
//! failures. Called by worker and evaluator.

use std::io;
use std::path::Path;
use std::time::Duration;

use dmprl_shared::config::{ExperimentConfig, Hindsight};
use dmprl_shared::supervision::{Report, Supervisor};
use thiserror::Error;
use tracing::info;

use crate::python_env::{Interpreter, InterpreterOptions, PythonEnvironments, PythonError};
use crate::watchdog;

/// Why environments could not be created.
#[derive(Debug, Error)]
pub enum EnvironmentsError {
    /// Python failed.
    #[error(transparent)]
    Python(#[from] PythonError),
    /// The watchdog's thread could not be started.
    #[error("cannot start the watchdog")]
    Watchdog(#[source] io::Error),
}

/// Starts the interpreter of a run in a virtual environment.
///
/// # Errors
/// As [`Interpreter::start`].
pub fn interpreter(venv: &Path, config: &ExperimentConfig) -> Result<Interpreter, PythonError> {
    let python_path = config.task.python_path.iter().map(Into::into).collect();
    Interpreter::start(&InterpreterOptions { venv: venv.to_owned(), python_path })
}

/// Creates `count` environments of the run's task, which execute `steps` at a call, and watches
/// every call into them. With hindsight, it also looks for their goal rule.
///
/// # Errors
/// If the environments cannot be created, the watchdog cannot be started, or hindsight is
/// configured and they have no goals.
pub fn make(
    interpreter: &Interpreter,
    config: &ExperimentConfig,
    count: usize,
    steps: usize,
    on_hang: impl FnOnce(String) + Send + 'static,
) -> Result<PythonEnvironments, EnvironmentsError> {
    let mut environments = PythonEnvironments::start(interpreter, &config.task, count, steps)?;
    watch(&environments, config, on_hang)?;
    if config.replay.hindsight != Hindsight::None {
        environments.find_goal_rule()?;
    }
    Ok(environments)
}

/// Starts a watchdog: if a call into the environments does not return in time, it calls `on_hang`
/// with a message, on its own thread. The hanging thread may hold the GIL forever, so only a new
/// process can continue.
///
/// # Errors
/// The watchdog cannot be started.
pub fn watch(
    environments: &PythonEnvironments,
    config: &ExperimentConfig,
    on_hang: impl FnOnce(String) + Send + 'static,
) -> Result<(), EnvironmentsError> {
    let seconds = config.actors.env_call_timeout_s;
    // A timeout that `Duration` cannot represent means no timeout.
    let timeout = Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
    let id = environments.spec().id.clone();
    let hung = move |hang: watchdog::Hang| {
        on_hang(format!(
            "{id}: an environment hangs: `{}` has not returned for {:.1} s \
             (actors.env_call_timeout_s = {seconds})",
            hang.kind.name(),
            hang.lasted.as_secs_f64()
        ));
    };
    watchdog::watch(environments.calls(), timeout, hung).map_err(EnvironmentsError::Watchdog)
}

/// Logs each failure of an environment, reports their number to the supervisor and returns it.
pub fn report_failures(failures: &[String], supervisor: &dyn Supervisor) -> u64 {
    let count = failures.len() as u64;
    let Some(last) = failures.last() else { return count };
    for failure in failures {
        info!("environment failure: {failure}");
    }
    // If the supervisor is gone, a stop is requested, which ends the loop.
    let _ = supervisor.report(&Report::EnvFailures { count, last: last.clone() });
    count
}
