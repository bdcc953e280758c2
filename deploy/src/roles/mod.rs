//! The parts that `dmprl train` starts as processes of their own: learner, actor, evaluator.
//!
//! A role opens its [`ControlPipe`] first, then its run directory, and answers every
//! [`crate::control::Command`]. Its standard error is its log; what it returns as an error ends
//! up there too, and the supervisor shows the last lines to the user.

#[cfg(feature = "python")]
mod actor;
mod arguments;
mod control_pipe;
#[cfg(feature = "python")]
mod environments;
#[cfg(feature = "python")]
mod evaluator;
mod gateway;
mod hardening;
mod heartbeat;
#[cfg(feature = "python")]
mod joined;
mod learner;
mod learner_files;
#[cfg(feature = "python")]
mod observer;
#[cfg(feature = "python")]
mod one_process;
mod relay;
mod setup;

use crate::failure::Outcome;

use hardening::harden;

pub use arguments::{ActorArgs, EvaluatorArgs, GatewayArgs, LearnerArgs, ObserverArgs, RelayArgs};
pub use control_pipe::{ControlPipe, ORPHAN_LIMIT, ORPHANED_LEARNER_LIMIT};
pub(crate) use setup::Setup;

/// Replays, updates, publishes, writes checkpoints; with `--one-process` also steps and
/// evaluates.
///
/// # Errors
/// Whatever keeps it from going on; the run then ends.
pub fn learner(args: &LearnerArgs) -> anyhow::Result<()> {
    harden()?;
    let control = ControlPipe::open(ORPHANED_LEARNER_LIMIT)?;
    if !args.one_process {
        return learner::run(args, &control);
    }
    #[cfg(feature = "python")]
    return one_process::run(args, &control);
    #[cfg(not(feature = "python"))]
    anyhow::bail!("{WITHOUT_PYTHON}")
}

/// Steps environments with the newest policy and sends the segments.
///
/// # Errors
/// Whatever keeps it from going on; the supervisor starts it again, unless it had joined.
#[cfg(feature = "python")]
pub fn actor(args: &ActorArgs) -> anyhow::Result<Outcome> {
    harden()?;
    if let Some(run) = &args.join {
        return joined::join(run);
    }
    actor::run(args, &ControlPipe::open(ORPHAN_LIMIT)?).map(|()| Outcome::Done)
}

/// Stands for the workers of other hosts.
///
/// # Errors
/// Whatever keeps it from going on; the supervisor starts it again.
pub fn gateway(args: &GatewayArgs) -> anyhow::Result<()> {
    harden()?;
    gateway::run(args, &ControlPipe::open(ORPHAN_LIMIT)?)
}

/// Stands for the learner on a host that has none.
///
/// # Errors
/// Whatever keeps it from going on; the supervisor starts it again if it crashed.
pub fn relay(args: &RelayArgs) -> anyhow::Result<()> {
    harden()?;
    relay::run(args, &ControlPipe::open(ORPHAN_LIMIT)?)
}

/// Evaluates saved policies without noise.
///
/// # Errors
/// Whatever keeps it from going on; the supervisor starts it again.
#[cfg(feature = "python")]
pub fn evaluator(args: &EvaluatorArgs) -> anyhow::Result<()> {
    harden()?;
    evaluator::run(args, &ControlPipe::open(ORPHAN_LIMIT)?)
}

/// Rolls a saved policy out and writes down what the robot does.
///
/// # Errors
/// Whatever keeps it from going on.
#[cfg(feature = "python")]
pub fn observer(args: &ObserverArgs) -> anyhow::Result<()> {
    harden()?;
    observer::run(args, &ControlPipe::open(ORPHAN_LIMIT)?)
}

#[cfg(not(feature = "python"))]
const WITHOUT_PYTHON: &str = "this program was built without the feature `python`";

/// Stands in for the worker in a learner-only build.
///
/// # Errors
/// Always.
#[cfg(not(feature = "python"))]
pub fn actor(_args: &ActorArgs) -> anyhow::Result<Outcome> {
    anyhow::bail!("{WITHOUT_PYTHON}")
}

/// Stands in for the evaluator in a learner-only build.
///
/// # Errors
/// Always.
#[cfg(not(feature = "python"))]
pub fn evaluator(_args: &EvaluatorArgs) -> anyhow::Result<()> {
    anyhow::bail!("{WITHOUT_PYTHON}")
}

/// Stands in for the observer in a learner-only build.
///
/// # Errors
/// Always.
#[cfg(not(feature = "python"))]
pub fn observer(_args: &ObserverArgs) -> anyhow::Result<()> {
    anyhow::bail!("{WITHOUT_PYTHON}")
}
