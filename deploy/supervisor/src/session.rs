//! Runs one session of a run: creates the shared memory, then starts the supervisor.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use dmprl_run::title;
use dmprl_run::{LockWatch, RunDirectory};
use dmprl_shared::config::ExperimentConfig;

use super::domain;
use super::launcher::Launcher;
use super::limits::TimeLimits;
use super::observer::{RunEvent, RunObserver};
use super::signals::interrupts;
use super::supervisor::{SessionReport, SupervisorPlan, supervise};
use super::totals::Totals;

/// Maximum wait of `resume` for the learner of a killed supervisor to write its checkpoint.
pub const RESUME_WAIT: Duration = Duration::from_secs(70);

/// A session to run, in a run directory that is ready for training.
pub struct SessionPlan {
    /// The program that plays the roles: this one, or a fake in tests.
    pub program: PathBuf,
    /// The run. The caller holds its lock until the session has ended, and children inherit it.
    pub run: RunDirectory,
    /// Tells whether the lock was lost.
    pub lock: LockWatch,
    /// The resolved configuration.
    pub config: ExperimentConfig,
    /// The Python virtual environment.
    pub venv: Option<PathBuf>,
    /// Whether the run has been trained before and resumes from its last checkpoint.
    pub resume: bool,
    /// Counts of earlier sessions of the run.
    pub earlier: Totals,
    /// Special settings for `dmprl chaos`.
    pub trial: Trial,
}

/// Settings of a run whose processes are killed deliberately.
#[derive(Debug, Default)]
pub struct Trial {
    /// Directory of the journals of workers and learner.
    pub journal: Option<PathBuf>,
    /// Maximum back-off before a restart; `None` for the default.
    pub restart_max: Option<Duration>,
}

/// Trains until the run ends, is stopped or fails.
///
/// # Errors
/// The session could not start. Later failures are in the report.
pub fn session(plan: SessionPlan, observer: &mut dyn RunObserver) -> anyhow::Result<SessionReport> {
    let SessionPlan { program, run, lock, config, venv, resume, earlier, trial } = plan;
    let manifest = run.manifest()?;
    let resume = resume && can_resume(&run, observer)?;
    let evaluations = run.evaluations()?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the supervisor's runtime")?;
    // Catch signals before creating shared memory: a fatal signal would leave it behind.
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
    let (title, path) = (title(&config), run.path().to_owned());
    observer.on_event(RunEvent::Started { title, run: path, learner: None, evaluations });
    let mut limits = TimeLimits::default();
    limits.restart_max = trial.restart_max.unwrap_or(limits.restart_max);
    let plan = SupervisorPlan { launcher, lock, config, limits, earlier, interrupts };
    let report = runtime.block_on(supervise(plan, observer));
    // The runtime kills remaining children, which must not outlive their shared memory.
    drop(runtime);
    drop(domain);
    Ok(report)
}

/// Returns whether the run has a checkpoint. A run without one starts over, without the rows of
/// the first attempt.
fn can_resume(run: &RunDirectory, observer: &mut dyn RunObserver) -> anyhow::Result<bool> {
    if run.has_checkpoint()? {
        return Ok(true);
    }
    let message = "the run has no checkpoint yet: it starts from the beginning".to_owned();
    observer.on_event(RunEvent::Warning { process: None, message });
    run.begin_again()?;
    Ok(false)
}
