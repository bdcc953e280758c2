//! `dmprl chaos`: kills and suspends the processes of a real run by a seeded schedule, and checks
//! their journals.
//!
//! ```text
//!   schedule ─► nemesis ──SIGKILL, SIGSTOP──► train (subject) ─► workers, learner
//!                  │                                                  │ journals
//!                  ▼                                                  ▼
//!               timeline ◄────────── recovery of processes ─────── journals ─► checker ─► report
//! ```
//! One loop in one thread reads the journals, injects due faults and checks progress, every few
//! milliseconds. At the end suspended processes are resumed, all workers must make progress, the
//! run is stopped as by a user, and its files are compared with the journals.

mod checker;
pub mod journal;
mod journals;
mod nemesis;
mod post_run_checks;
mod report;
mod samples;
mod schedule;
mod subject;
mod timeline;
mod trial;
mod violations;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use dmprl_run::RunDirectory;
use dmprl_run::{Progress, Watch};
pub use report::Report;
use subject::Subject;
use trial::Trial;

/// Plan of a trial.
pub struct TrialPlan {
    /// Program of all processes: this one.
    pub program: PathBuf,
    /// Task to train.
    pub task: String,
    /// Number of worker processes.
    pub workers: u32,
    /// Seed of the schedule and of the run.
    pub seed: u64,
    /// Minimum duration of the fault injection.
    pub duration: Duration,
    /// Minimum number of worker kills.
    pub worker_kills: u64,
    /// Minimum number of learner kills.
    pub learner_kills: u64,
    /// Folder for all files, which is kept. `None` for a temporary folder, which is kept only if a
    /// check fails.
    pub output: Option<PathBuf>,
}

/// Runs a trial and checks it.
///
/// # Errors
/// The trial itself failed. Violations are in the report, not errors.
pub fn chaos(plan: &TrialPlan, progress: &dyn Progress) -> anyhow::Result<Report> {
    let watch = Watch::start()?;
    let (folder, temporary) = match &plan.output {
        Some(folder) => {
            RunDirectory::check_free(folder).context("cannot use --output")?;
            std::fs::create_dir_all(folder)
                .with_context(|| format!("cannot make {}", folder.display()))?;
            (std::fs::canonicalize(folder).context("cannot resolve --output")?, None)
        }
        None => {
            let made = tempfile::Builder::new().prefix("dmprl-chaos-").tempdir();
            let made = made.context("cannot make a temporary folder")?;
            (made.path().to_owned(), Some(made))
        }
    };
    let tried = Subject::start(plan, &folder)
        .and_then(|subject| Trial::new(plan, subject))
        .and_then(|trial| trial.run(&watch, progress));
    let mut report = match tried {
        Ok(report) => report,
        Err(error) => {
            // The files show the reason.
            let _ = temporary.map(tempfile::TempDir::keep);
            return Err(error.context(format!("the trial failed; see {}", folder.display())));
        }
    };
    let kept = plan.output.is_some() || !report.is_sound();
    report.kept = kept.then(|| folder.display().to_string());
    if let Some(made) = temporary.filter(|_| kept) {
        let _ = made.keep();
    }
    Ok(report)
}
