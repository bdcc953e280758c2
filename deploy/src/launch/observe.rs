//! Episodes of a saved policy outside training, written down step by step.

use std::path::PathBuf;
use std::time::Duration;

use super::conversation::{Conversation, Turn};
use super::{Launcher, TimeLimits};
use crate::control::Report;
use crate::failure::Outcome;
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
    /// The file of episodes that the observer writes.
    pub output: PathBuf,
    /// A folder for frames, if they are wanted.
    pub pictures: Option<PathBuf>,
}

/// Observes; `progress` is called with the number of episodes done, and of steps of the next one: 0
/// when an episode has just ended.
///
/// # Errors
/// The observer died or took too long.
pub fn observe(plan: ObservationPlan<'_>, progress: &dyn Fn(u64, u64)) -> anyhow::Result<Outcome> {
    let program = plan.program.clone();
    let launcher = Launcher::outside_training(program, plan.run, plan.venv.clone());
    let command = launcher.observe(&plan)?;
    // A report follows each call into the environment, over which the watchdog watches.
    let seconds = plan.run.config()?.actors.env_call_timeout_s;
    let call = Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
    let limit = TimeLimits::default().evaluation_of(1).saturating_add(call);
    let observer = Conversation { who: "the observer", log: plan.run.log_path("observer") };
    let answer = observer.hold(command, |report| {
        Ok(match report {
            Report::EnvironmentReady { .. } => Turn::Wait("done", limit),
            Report::Observed { episodes, steps } => {
                progress(episodes, steps);
                match episodes < plan.episodes {
                    true => Turn::Wait("done", limit),
                    false => Turn::Over(()),
                }
            }
            _ => Turn::GoOn,
        })
    })?;
    Ok(answer.map_or(Outcome::Interrupted, |()| Outcome::Done))
}
