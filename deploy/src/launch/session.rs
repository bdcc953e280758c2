//! One session of a run: what stands around the supervisor, and what the user is told at the end.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use dmprl_shared::config::ExperimentConfig;

use super::{
    Ending, Launcher, SessionReport, SupervisorPlan, TimeLimits, domain, interrupts, supervise,
};
use crate::failure::Outcome;
use crate::plots;
use crate::run_directory::{RunDirectory, RunLock};
use crate::tensorboard::Mirror;
use crate::terminal::{Display, ProgressStyle, say, shown, summary};

/// How long `resume` waits for the learner of a killed supervisor to write its checkpoint.
pub const RESUME_WAIT: Duration = Duration::from_secs(70);

/// A run directory, ready to be trained in.
pub struct SessionPlan {
    /// The program that plays the roles: this one; tests put a fake here.
    pub program: PathBuf,
    /// The run.
    pub run: RunDirectory,
    /// Held until the end, and by every child.
    pub lock: RunLock,
    /// The resolved configuration.
    pub config: ExperimentConfig,
    /// The Python virtual environment.
    pub venv: Option<PathBuf>,
    /// Whether the run has been trained before.
    pub resume: bool,
    /// Bar or lines.
    pub progress: ProgressStyle,
    /// What `dmprl chaos` wants to be otherwise.
    pub trial: Trial,
}

/// What differs in a run whose processes are killed on purpose.
#[derive(Debug, Default)]
pub struct Trial {
    /// Where worker and learner note what they do.
    pub journal: Option<PathBuf>,
    /// The longest pause before a restart: a death on purpose is no sign of more to come.
    pub restart_max: Option<Duration>,
}

/// Trains until the run ends, is stopped or fails; then draws and tells.
///
/// # Errors
/// Whatever kept the run from going on.
pub fn session(plan: SessionPlan) -> anyhow::Result<Outcome> {
    let SessionPlan { program, run, lock, config, venv, resume, progress, trial } = plan;
    let manifest = run.manifest()?;
    let mut display = Display::new(progress, config.run.steps);
    let resume = resume && can_resume(&run, &mut display)?;
    display.begin_with(run.evaluations()?);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the supervisor's runtime")?;
    // Before the shared memory: a signal that still kills would leave it behind.
    let interrupts = runtime.block_on(async { interrupts() })?;
    let domain = match config.run.deterministic {
        true => None,
        false => Some(domain::create(&domain::token(&manifest, std::process::id()))?),
    };
    let launcher = Launcher {
        program,
        run: run.clone(),
        venv,
        domain: domain.as_ref().map(|domain| domain.path().to_owned()),
        resume,
        init_from: manifest.init_from.map(PathBuf::from),
        learner_restarts: 0,
        sessions_before: u32::try_from(manifest.sessions.len().saturating_sub(1))
            .context("too many sessions")?,
        journal: trial.journal,
        upstream: None,
    };
    let title = title(&config);
    display.message(&format!("training {title} in {}", shown(run.path())));
    let mut limits = TimeLimits::default();
    limits.restart_max = trial.restart_max.unwrap_or(limits.restart_max);
    let steps_total = config.run.steps;
    let mirror = Mirror::start(&run);
    let report = runtime.block_on(async {
        let plan = SupervisorPlan { launcher, config, limits, display, interrupts };
        supervise(plan).await
    });
    // In this order: no child, then nothing half-made, then no lock.
    drop(runtime);
    drop(domain);
    drop(mirror);
    if let Err(error) = run.remove_half_written() {
        say(&format!("warning: {error:#}"));
    }
    drop(lock);
    conclude(report, &run, &title, steps_total)
}

/// A run without a checkpoint begins again, without the rows of the first attempt.
fn can_resume(run: &RunDirectory, display: &mut Display) -> anyhow::Result<bool> {
    if run.has_checkpoint()? {
        return Ok(true);
    }
    display.message("the run has no checkpoint yet: it begins again");
    run.begin_again()?;
    Ok(false)
}

/// What is trained, in one line.
#[must_use]
pub fn title(config: &ExperimentConfig) -> String {
    let policy = format!("{:?}", config.policy.kind).to_lowercase();
    let algorithm = format!("{:?}", config.algorithm.name).to_lowercase();
    let actors = &config.actors;
    let count =
        |count: usize, what: &str| format!("{count} {what}{}", if count == 1 { "" } else { "s" });
    let process = if config.run.deterministic { "one process, " } else { "" };
    let workers = count(actors.workers, "worker");
    let hands = format!("{process}{workers} × {}", count(actors.envs_per_worker, "environment"));
    let (task, seed) = (&config.task.name, config.run.seed);
    format!("{task} · {algorithm} · {policy} · seed {seed} · {hands}")
}

fn conclude(
    mut report: SessionReport,
    run: &RunDirectory,
    title: &str,
    steps_total: u64,
) -> anyhow::Result<Outcome> {
    if let Err(error) = plots::learning_curve(run, title) {
        // The results are there; a picture is no reason to fail.
        say(&format!("warning: {error:#}"));
    }
    let lost = match run.has_checkpoint() {
        Ok(true) => "the last checkpoint is missing: a resume goes back to the one before it",
        Ok(false) => "there is no checkpoint: a resume begins again",
        Err(_) => "the checkpoints cannot be read",
    };
    match report.ending {
        Ending::Failed(error) => Err(error),
        Ending::Interrupted => {
            let path = shown(run.path());
            say(if report.checkpointed { "checkpoint written" } else { lost });
            say(&format!("go on with: dmprl resume {path}"));
            Ok(Outcome::Interrupted)
        }
        Ending::Completed => {
            // A session that had nothing to do shows what the run has reached.
            if report.last_row.is_none() {
                report.last_row = run.latest_row()?;
            }
            say(&format!("\n{}", summary(&report, title, run.path(), steps_total)));
            if !report.checkpointed {
                say(&format!("warning: {lost}"));
            }
            Ok(Outcome::Done)
        }
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Limits;

    use super::*;

    #[test]
    fn a_deterministic_run_has_one_worker_whatever_was_asked_for() {
        let mut config = ExperimentConfig::default();
        (config.actors.workers, config.run.deterministic) = (4, true);
        let config = config.resolve(Limits { cores: 8 }).unwrap();
        assert!(title(&config).ends_with("one process, 1 worker × 8 environments"));
    }
}
