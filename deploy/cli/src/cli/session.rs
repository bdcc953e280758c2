//! Runs a session for `train` and `resume`: calls [`dmprl_supervisor::session`], shows its progress
//! on the terminal, writes TensorBoard files, draws the learning curve and prints a summary.

use std::path::PathBuf;

use dmprl_analysis::plots;
use dmprl_analysis::tensorboard::Mirror;
use dmprl_learner::checkpoint;
use dmprl_run::failure::Outcome;
use dmprl_run::format::shown;
use dmprl_run::title;
use dmprl_run::{FileSystem, RunDirectory, RunLock};
use dmprl_shared::config::ExperimentConfig;
use dmprl_supervisor::{
    self as launch, Ending, RunEvent, RunObserver, SessionPlan, SessionReport, Totals, Trial,
};

use super::output::observer;
use crate::terminal::{ProgressStyle, events, say, summary, write_line};

/// A session to run, in a run directory that is ready for training.
pub struct TrainingPlan {
    /// The program that plays the roles: this one, or a fake in tests.
    pub program: PathBuf,
    /// The run.
    pub run: RunDirectory,
    /// The run's lock, held until the session ends.
    pub lock: RunLock,
    /// The resolved configuration.
    pub config: ExperimentConfig,
    /// The Python virtual environment.
    pub venv: Option<PathBuf>,
    /// Whether the run has been trained before and resumes from its last checkpoint.
    pub resume: bool,
    /// How to show the progress.
    pub progress: ProgressStyle,
    /// Special settings for `dmprl chaos`.
    pub trial: Trial,
}

/// Shows a session, and mirrors the run's rows to TensorBoard files while it runs.
struct SessionObserver {
    display: Box<dyn RunObserver>,
    mirrored: RunDirectory,
    mirror: Option<Mirror>,
}

impl RunObserver for SessionObserver {
    fn on_event(&mut self, event: RunEvent) {
        if matches!(event, RunEvent::Started { .. }) {
            self.mirror = Some(Mirror::start(&self.mirrored));
        }
        self.display.on_event(event);
    }

    fn shows_processes(&self) -> bool {
        self.display.shows_processes()
    }
}

/// Names the file system of a run directory, if it cannot promise something that runs need.
pub(super) fn name_limits(run: &RunDirectory) {
    // If it cannot be found out, the run works as well.
    let Ok(file_system) = FileSystem::of(run.path()) else { return };
    if let Some(concern) = file_system.concern() {
        say(&format!("the run directory is on {file_system}: {concern}"));
    }
}

/// Trains until the run ends, is stopped or fails. Then draws the learning curve and prints a
/// summary.
///
/// # Errors
/// The failure that ended the run.
pub fn train_session(plan: TrainingPlan) -> anyhow::Result<Outcome> {
    let TrainingPlan { program, run, lock, config, venv, resume, progress, trial } = plan;
    let (title, steps_total) = (title(&config), config.run.steps);
    let mut session_observer = SessionObserver {
        display: observer(progress, &config.run),
        mirrored: run.clone(),
        mirror: None,
    };
    let earlier = earlier_sessions(&run)?;
    let plan = SessionPlan {
        program,
        run: run.clone(),
        lock: lock.watch(),
        config,
        venv,
        resume,
        earlier,
        trial,
    };
    let report = launch::session(plan, &mut session_observer)?;
    drop(session_observer);
    // If another process trains the run now, its files are not touched.
    if lock.watch().lost_to().is_none() {
        if let Err(error) = run.remove_half_written() {
            say(&format!("warning: {error:#}"));
        }
        drop(lock);
        if let Err(error) = plots::learning_curve(&run, &title) {
            // The results are complete without the plot.
            say(&format!("warning: {error:#}"));
        }
    }
    match progress {
        ProgressStyle::Events => {
            write_line(&events::finished(&report));
            outcome(report.ending)
        }
        _ => conclude(report, &run, &title, steps_total),
    }
}

fn earlier_sessions(run: &RunDirectory) -> anyhow::Result<Totals> {
    let counters = checkpoint::counters(&run.checkpoints_path())?;
    Ok(counters.last().map_or_else(Totals::default, |counters| Totals {
        env_failures: counters.env_failures,
        sent: counters.sent,
        learner_restarts: counters.learner_restarts,
        worker_restarts: counters.worker_restarts,
    }))
}

fn outcome(ending: Ending) -> anyhow::Result<Outcome> {
    match ending {
        Ending::Failed(error) => Err(error),
        Ending::Interrupted => Ok(Outcome::Interrupted),
        Ending::Completed => Ok(Outcome::Done),
    }
}

/// Tells the user how the session ended and how to resume it.
fn conclude(
    mut report: SessionReport,
    run: &RunDirectory,
    title: &str,
    steps_total: u64,
) -> anyhow::Result<Outcome> {
    let lost = match run.has_checkpoint() {
        Ok(true) => "the last checkpoint was not written: the run resumes from the one before",
        Ok(false) => "there is no checkpoint: the run resumes from the beginning",
        Err(_) => "the checkpoints cannot be read",
    };
    match &report.ending {
        Ending::Failed(_) => {}
        Ending::Interrupted => {
            let path = shown(run.path());
            say(if report.checkpointed { "checkpoint written" } else { lost });
            say(&format!("resume with: dmprl resume {path}"));
        }
        Ending::Completed => {
            // A session without training steps shows the newest result of the run.
            if report.last_row.is_none() {
                report.last_row = run.latest_row()?;
            }
            say(&format!("\n{}", summary(&report, title, run.path(), steps_total)));
            if !report.checkpointed {
                say(&format!("warning: {lost}"));
            }
        }
    }
    outcome(report.ending)
}
