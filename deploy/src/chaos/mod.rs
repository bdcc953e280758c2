//! `dmprl chaos`: a real run whose processes are killed and stopped by a seeded schedule, and a
//! checker that reads what they noted.
//!
//! ```text
//!   schedule ─► nemesis ──SIGKILL, SIGSTOP──► train (subject) ─► workers, learner
//!                  │                                                  │ journals
//!                  ▼                                                  ▼
//!               timeline ◄──────────── when who came back ──────── journals ─► checker ─► report
//! ```
//! One loop in one thread, every few milliseconds: read what was noted, strike if it is time, look
//! whether work goes on. At the end everybody is let go, all workers must make progress, the run is
//! stopped as a user stops it, and what it leaves on disk is compared with what was noted.

mod aftermath;
mod checker;
mod journals;
mod nemesis;
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

use crate::bench::Watch;
use crate::run_directory::RunDirectory;
pub use report::Report;
use subject::Subject;
use trial::Trial;

/// What is to be tried.
pub struct TrialPlan {
    /// The program that plays every part: this one.
    pub program: PathBuf,
    /// What is trained.
    pub task: String,
    /// Worker processes.
    pub workers: u32,
    /// Of the schedule, and of the run.
    pub seed: u64,
    /// How long the run is struck, at least.
    pub duration: Duration,
    /// How many workers are killed, at least.
    pub worker_kills: u64,
    /// How many learners are killed, at least.
    pub learner_kills: u64,
    /// Where everything goes and stays; none: a temporary folder, kept if something did not hold.
    pub output: Option<PathBuf>,
}

/// Tries a run and judges it.
///
/// # Errors
/// The trial itself was not possible; what did not hold is in the report.
pub fn chaos(plan: &TrialPlan) -> anyhow::Result<Report> {
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
        .and_then(|trial| trial.run(&watch));
    let mut report = match tried {
        Ok(report) => report,
        Err(error) => {
            // What it left says why.
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
