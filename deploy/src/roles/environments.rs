//! The environments of a role, and what it does about those that fail or hang.

use std::time::Duration;

use anyhow::Context;
use dmprl_actors::python_env::{Interpreter, PythonEnvironments};
use dmprl_actors::watchdog;
use dmprl_shared::config::ExperimentConfig;

use super::ControlPipe;
use crate::control::{ENV_HUNG_STATUS, Report};
use crate::terminal::say;

/// Tells of failed environments: each in the log, their number to the supervisor. Returns it.
pub fn tell(failures: &[String], control: &ControlPipe) -> u64 {
    let count = failures.len() as u64;
    let Some(last) = failures.last() else { return count };
    for failure in failures {
        say(&format!("environment failure: {failure}"));
    }
    // A supervisor that is gone is noticed as a stop.
    let _ = control.send(&Report::EnvFailures { count, last: last.clone() });
    count
}

/// Makes `count` environments of the run's task, and watches over every call into them.
pub fn make(
    interpreter: &Interpreter,
    config: &ExperimentConfig,
    count: usize,
    control: &ControlPipe,
) -> anyhow::Result<PythonEnvironments> {
    let steps = config.policy.decision_steps();
    let environments = PythonEnvironments::start(interpreter, &config.task.id, count, steps)?;
    watch(&environments, config, control)?;
    Ok(environments)
}

/// Ends this process when a call into the environments does not return: nothing but another
/// process could help, and the supervisor starts one.
pub fn watch(
    environments: &PythonEnvironments,
    config: &ExperimentConfig,
    control: &ControlPipe,
) -> anyhow::Result<()> {
    let seconds = config.actors.env_call_timeout_s;
    // A limit beyond what a clock can hold is none.
    let timeout = Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
    let (id, reporter) = (environments.spec().id.clone(), control.reporter());
    let hung = move |hang: watchdog::Hang| {
        let message = format!(
            "{id}: an environment hangs: `{}` has not returned for {:.1} s \
             (actors.env_call_timeout_s = {seconds})",
            hang.kind.name(),
            hang.lasted.as_secs_f64()
        );
        say(&format!("error: {message}"));
        // A supervisor that is gone changes nothing.
        let _ = reporter.send(&Report::EnvHung { message });
        // SAFETY: `_exit` takes a number and does not return. Not `exit`, whose handlers and
        // destructors would wait for the thread that hangs.
        unsafe { libc::_exit(ENV_HUNG_STATUS) }
    };
    watchdog::watch(environments.calls(), timeout, hung).context("cannot start the watchdog")
}
