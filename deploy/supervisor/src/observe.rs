//! Records episodes of a saved policy step by step, outside training.

use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use dmprl_control::Report;
use dmprl_run::RunDirectory;
use dmprl_run::failure::Outcome;

use super::conversation::{Conversation, Turn};
use super::launcher::Launcher;
use super::limits::TimeLimits;

/// Episodes to record.
pub struct ObservationPlan<'a> {
    /// The program that plays the observer: this one.
    pub program: PathBuf,
    /// The run.
    pub run: &'a RunDirectory,
    /// The Python virtual environment.
    pub venv: Option<PathBuf>,
    /// Version of the saved policy.
    pub policy_version: u64,
    /// Seed of the first episode; episode i is reset with `first_seed + i`.
    pub first_seed: u64,
    /// Number of episodes.
    pub episodes: u64,
    /// File that the observer writes.
    pub output: PathBuf,
    /// Folder for frames; `None` records no frames.
    pub pictures: Option<PathBuf>,
    /// Whether to write observations, commands and segments too.
    pub details: bool,
}

impl ObservationPlan<'_> {
    fn command(&self) -> Command {
        let mut command = Command::new(&self.program);
        command.arg("observer").arg("--run").arg(self.run.path());
        for (flag, number) in [
            ("--policy", self.policy_version),
            ("--first-seed", self.first_seed),
            ("--episodes", self.episodes),
        ] {
            command.args([flag, &number.to_string()]);
        }
        command.arg("--output").arg(&self.output);
        if let Some(pictures) = &self.pictures {
            command.arg("--pictures").arg(pictures);
        }
        if self.details {
            command.arg("--details");
        }
        if let Some(venv) = &self.venv {
            command.arg("--venv").arg(venv);
        }
        command
    }
}

/// Records the episodes. Calls `progress` with the number of completed episodes and the number of
/// steps of the next one, which is 0 when an episode has just ended.
///
/// # Errors
/// The observer died or took too long.
pub fn observe(plan: ObservationPlan<'_>, progress: &dyn Fn(u64, u64)) -> anyhow::Result<Outcome> {
    let launcher = Launcher::outside_training(plan.program.clone(), plan.run, plan.venv.clone());
    let command = launcher.streams(plan.command(), "observer")?;
    // A report follows each call into the environment, and the watchdog limits the call's duration.
    let seconds = plan.run.config()?.actors.env_call_timeout_s;
    let call = Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
    let limit = TimeLimits::default().evaluation_of(1).saturating_add(call);
    let observer = Conversation { who: "the observer", log: plan.run.log_path("observer") };
    let answer = observer.hold(command, |report| {
        Ok(match report {
            Report::EnvironmentReady { .. } => Turn::Wait(limit),
            Report::Observed { episodes, steps } => {
                progress(episodes, steps);
                match episodes < plan.episodes {
                    true => Turn::Wait(limit),
                    false => Turn::Done(()),
                }
            }
            _ => Turn::Continue,
        })
    })?;
    Ok(answer.map_or(Outcome::Interrupted, |()| Outcome::Done))
}
