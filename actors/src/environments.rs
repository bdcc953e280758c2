//! Stage 3 of 8: makes the environments of a process, watches calls into them, reports failures.
//! Called by worker and evaluator.

use std::io;
use std::path::Path;
use std::time::Duration;

use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::supervision::{Report, Supervisor};
use thiserror::Error;
use tracing::info;

use crate::python_env::{Interpreter, InterpreterOptions, PythonEnvironments, PythonError};
use crate::watchdog;

/// Why environments could not be made.
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

/// Makes `count` environments of the run's task and watches every call into them.
///
/// # Errors
/// If the environments cannot be made or the watchdog cannot be started.
pub fn make(
    interpreter: &Interpreter,
    config: &ExperimentConfig,
    count: usize,
    on_hang: impl FnOnce(String) + Send + 'static,
) -> Result<PythonEnvironments, EnvironmentsError> {
    let steps = config.policy.decision_steps();
    let environments = PythonEnvironments::start(interpreter, &config.task.id, count, steps)?;
    watch(&environments, config, on_hang)?;
    Ok(environments)
}

/// Watches calls into the environments: if one does not return in time, calls `on_hang` with a
/// message on the watchdog's thread. The hanging thread may hold the interpreter forever, so only a
/// new process helps.
///
/// # Errors
/// The watchdog cannot be started.
pub fn watch(
    environments: &PythonEnvironments,
    config: &ExperimentConfig,
    on_hang: impl FnOnce(String) + Send + 'static,
) -> Result<(), EnvironmentsError> {
    let seconds = config.actors.env_call_timeout_s;
    // A limit that a clock cannot represent is no limit.
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

/// Logs each failure of an environment and reports their number to the supervisor; returns it.
pub fn report_failures(failures: &[String], supervisor: &dyn Supervisor) -> u64 {
    let count = failures.len() as u64;
    let Some(last) = failures.last() else { return count };
    for failure in failures {
        info!("environment failure: {failure}");
    }
    // If the supervisor is gone, the loop notices it as a stop.
    let _ = supervisor.report(&Report::EnvFailures { count, last: last.clone() });
    count
}
