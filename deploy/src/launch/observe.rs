//! Episodes of a saved policy outside training, written down step by step.

use std::path::PathBuf;

use super::conversation::{Conversation, Turn};
use super::{Launcher, TimeLimits};
use crate::control::Report;
use crate::failure::Outcome;
use crate::roles::ObserverArgs;
use crate::run_directory::RunDirectory;

/// What to observe.
pub struct ObservationPlan<'a> {
    /// The program that plays the observer: this one.
    pub program: PathBuf,
    /// The run.
    pub run: &'a RunDirectory,
    /// The Python virtual environment.
    pub venv: Option<PathBuf>,
    /// Which of its saved policies.
    pub policy_version: u64,
    /// Episode i is reset with seed `first_seed + i`.
    pub first_seed: u64,
    /// How many.
    pub episodes: u64,
    /// The file to write, which [`crate::motion::Recorded`] reads.
    pub output: PathBuf,
}

/// Observes; `progress` is called with the number of episodes done, and of how many.
///
/// # Errors
/// The observer died or took too long.
pub fn observe(plan: ObservationPlan<'_>, progress: &dyn Fn(u64, u64)) -> anyhow::Result<Outcome> {
    let launcher = Launcher::outside_training(plan.program, plan.run, plan.venv);
    let command = launcher.observe(&ObserverArgs {
        run: plan.run.path().to_owned(),
        policy: plan.policy_version,
        first_seed: plan.first_seed,
        episodes: plan.episodes,
        output: plan.output,
        venv: None,
    })?;
    let limits = TimeLimits::default();
    let limit_of = |done: u64| {
        limits.evaluation_of(usize::try_from(plan.episodes - done).unwrap_or(usize::MAX))
    };
    let observer = Conversation { who: "the observer", log: plan.run.log_path("observer") };
    let answer = observer.hold(command, |report| {
        Ok(match report {
            Report::EnvironmentReady { .. } => Turn::Wait("done", limit_of(0)),
            Report::Observed { episodes } => {
                progress(episodes, plan.episodes);
                match episodes < plan.episodes {
                    true => Turn::Wait("done", limit_of(episodes)),
                    false => Turn::Over(()),
                }
            }
            _ => Turn::GoOn,
        })
    })?;
    Ok(answer.map_or(Outcome::Interrupted, |()| Outcome::Done))
}
