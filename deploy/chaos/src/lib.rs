//! `dmprl chaos`: kills and suspends the processes of a real run by a seeded schedule, and checks
//! their journals.
//!
//! ```text
//!   schedule ─► fault_injector ──SIGKILL, SIGSTOP──► run_under_test ─► workers, learner
//!                    │                                                     │ journal
//!                    ▼                                                     ▼
//!                 timeline ◄────────── recovery of processes ────────── journals ─► checker
//!                                                                                     │
//!                                                                                     ▼
//!                                                                                   report
//! ```
//! One loop in one thread (`trial`) reads the journals, injects due faults and checks progress,
//! every few milliseconds. At the end it resumes suspended processes, waits until all workers make
//! progress, stops the run as a user would, and compares its files with the journals
//! (`post_run_checks`).

mod checker;
mod fault_injector;
pub mod journal;
mod journals;
mod post_run_checks;
mod report;
mod run_under_test;
mod samples;
mod schedule;
mod timeline;
mod trial;
mod violations;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use dmprl_run::RunDirectory;
use dmprl_run::{Progress, Watch};
pub use report::Report;
use run_under_test::RunUnderTest;
use trial::Trial;

/// Settings of a trial.
pub struct TrialPlan {
    /// Path of this program, which also runs the run's processes.
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
    /// Folder for all files, which is kept. With `None`, a temporary folder is used, which is kept
    /// only if a check fails.
    pub output: Option<PathBuf>,
}

/// Runs a trial and checks it.
///
/// # Errors
/// The trial itself fails. Violations are not errors, but part of the report.
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
            let created = tempfile::Builder::new().prefix("dmprl-chaos-").tempdir();
            let created = created.context("cannot make a temporary folder")?;
            (created.path().to_owned(), Some(created))
        }
    };
    let result = RunUnderTest::start(plan, &folder)
        .and_then(|run| Trial::new(plan, run))
        .and_then(|trial| trial.run(&watch, progress));
    let mut report = match result {
        Ok(report) => report,
        Err(error) => {
            // Keep the files, which show the reason.
            let _ = temporary.map(tempfile::TempDir::keep);
            return Err(error.context(format!("the trial failed; see {}", folder.display())));
        }
    };
    let kept = plan.output.is_some() || !report.is_sound();
    report.kept = kept.then(|| folder.display().to_string());
    if let Some(created) = temporary.filter(|_| kept) {
        let _ = created.keep();
    }
    Ok(report)
}
