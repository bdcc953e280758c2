//! Roles: the processes that other commands start. Learner, worker (`dmprl actor`), evaluator,
//! gateway, relay and observer.
//!
//! A role opens its [`ControlPipe`] first, then its run directory, and handles every
//! [`dmprl_control::Command`]. Its standard error is its log. It also logs the error that ends it,
//! and the supervisor shows the last lines to the user.

#[cfg(feature = "python")]
mod actor;
mod arguments;
#[cfg(feature = "python")]
mod environments;
#[cfg(feature = "python")]
mod evaluator;
mod gateway;
mod hardening;
#[cfg(feature = "python")]
mod joined;
mod learner;
mod learner_files;
#[cfg(feature = "python")]
mod observer;
#[cfg(feature = "python")]
mod one_process;
mod relay;

use dmprl_control::{ControlPipe, ORPHAN_LIMIT, ORPHANED_LEARNER_LIMIT};
use dmprl_run::failure::Outcome;
use hardening::harden;

pub use arguments::{ActorArgs, EvaluatorArgs, GatewayArgs, LearnerArgs, ObserverArgs, RelayArgs};

/// Runs the learner; with `--one-process` also the worker and the evaluator.
///
/// # Errors
/// The learner has failed; the run then ends.
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

/// Runs a worker.
///
/// # Errors
/// The worker has failed. The supervisor restarts it, unless it joined the run.
#[cfg(feature = "python")]
pub fn actor(args: &ActorArgs) -> anyhow::Result<Outcome> {
    harden()?;
    if let Some(run) = &args.join {
        return joined::join(run);
    }
    actor::run(args, &ControlPipe::open(ORPHAN_LIMIT)?).map(|()| Outcome::Done)
}

/// Runs the gateway, which acts as the workers of other hosts.
///
/// # Errors
/// The gateway has failed; the supervisor restarts it.
pub fn gateway(args: &GatewayArgs) -> anyhow::Result<()> {
    harden()?;
    gateway::run(args, &ControlPipe::open(ORPHAN_LIMIT)?)
}

/// Runs the relay, which acts as the learner on a host without one.
///
/// # Errors
/// The relay has failed; the supervisor restarts it if it crashed.
pub fn relay(args: &RelayArgs) -> anyhow::Result<()> {
    harden()?;
    relay::run(args, &ControlPipe::open(ORPHAN_LIMIT)?)
}

/// Runs the evaluator, which evaluates saved policies without noise.
///
/// # Errors
/// The evaluator has failed; the supervisor restarts it.
#[cfg(feature = "python")]
pub fn evaluator(args: &EvaluatorArgs) -> anyhow::Result<()> {
    harden()?;
    evaluator::run(args, &ControlPipe::open(ORPHAN_LIMIT)?)
}

/// Runs the observer, which records episodes of a saved policy.
///
/// # Errors
/// The observer has failed.
#[cfg(feature = "python")]
pub fn observer(args: &ObserverArgs) -> anyhow::Result<()> {
    harden()?;
    observer::run(args, &ControlPipe::open(ORPHAN_LIMIT)?)
}

#[cfg(not(feature = "python"))]
const WITHOUT_PYTHON: &str = "this program was built without the feature `python`";

/// Reports that this build has no worker.
///
/// # Errors
/// Always.
#[cfg(not(feature = "python"))]
pub fn actor(_args: &ActorArgs) -> anyhow::Result<Outcome> {
    anyhow::bail!("{WITHOUT_PYTHON}")
}

/// Reports that this build has no evaluator.
///
/// # Errors
/// Always.
#[cfg(not(feature = "python"))]
pub fn evaluator(_args: &EvaluatorArgs) -> anyhow::Result<()> {
    anyhow::bail!("{WITHOUT_PYTHON}")
}

/// Reports that this build has no observer.
///
/// # Errors
/// Always.
#[cfg(not(feature = "python"))]
pub fn observer(_args: &ObserverArgs) -> anyhow::Result<()> {
    anyhow::bail!("{WITHOUT_PYTHON}")
}
