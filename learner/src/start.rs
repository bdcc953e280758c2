//! Makes a run's learner: new, with another policy's parameters, from demonstrations, or from a
//! checkpoint and the segments logged since.

use std::path::{Path, PathBuf};

use dmprl_shared::config::{DeliveryLevel, ExperimentConfig};
use dmprl_shared::policy_file::{self, Match, PolicyFileError};
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::supervision::{Report, ReportError, Supervisor};
use dmprl_shared::transport::delivery::{LogError, LogIdentity, Replayed, SegmentLog};
use thiserror::Error;
use tracing::warn;

use crate::checkpoint::{self, CheckpointError};
use crate::demonstrations::{Demonstration, DemonstrationError, DemonstrationSummary};
use crate::learner::{Learner, LearnerError};
use crate::off_policy::CloningLosses;

/// Why a learner could not start.
#[derive(Debug, Error)]
pub enum StartError {
    /// The learner cannot be made.
    #[error(transparent)]
    Learner(#[from] LearnerError),
    /// No checkpoint is usable.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The demonstrations cannot be used.
    #[error(transparent)]
    Demonstrations(#[from] DemonstrationError),
    /// The policy file to start from cannot be used.
    #[error("cannot start from the policy file {}", path.display())]
    Policy {
        /// The file.
        path: PathBuf,
        /// The reason.
        #[source]
        cause: PolicyFileError,
    },
    /// The segment log cannot be used.
    #[error("cannot use the segment log {}", path.display())]
    Log {
        /// The file.
        path: PathBuf,
        /// The reason.
        #[source]
        cause: LogError,
    },
    /// A report could not be sent.
    #[error(transparent)]
    Report(#[from] ReportError),
}

/// The initial state of a learner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin<'a> {
    /// New networks or the parameters of this policy file, and the configured demonstrations.
    New(Option<&'a Path>),
    /// The newest usable checkpoint in this folder.
    Checkpoint(&'a Path),
}

/// A run, as its learner needs it.
#[derive(Debug, Clone, Copy)]
pub struct Run<'a> {
    /// The experiment.
    pub config: &'a ExperimentConfig,
    /// Properties of the environments.
    pub spec: &'a EnvSpec,
    /// The run's id, which its segments carry.
    pub run_id: u64,
}

/// Makes the learner of a run. Warns about each rejected checkpoint.
///
/// # Errors
/// If the learner cannot be made from `origin`, or the supervisor is gone.
pub fn learner(
    run: Run<'_>,
    origin: Origin<'_>,
    supervisor: &dyn Supervisor,
) -> Result<Learner, StartError> {
    let fresh = || Learner::new(run.config.clone(), run.spec, run.run_id);
    let policy = match origin {
        Origin::New(policy) => policy,
        Origin::Checkpoint(folder) => {
            let (learner, loaded) = checkpoint::load_newest(folder, &fresh)?;
            for error in loaded.rejected {
                let message = format!("a checkpoint was rejected, an older one is used: {error}");
                warn!("{message}");
                supervisor.report(&Report::Warning { message })?;
            }
            return Ok(learner);
        }
    };
    let mut learner = fresh()?;
    if let Some(path) = policy {
        let snapshot = policy_file::load(path, learner.policy(), Match::Sizes)
            .map_err(|cause| StartError::Policy { path: path.to_owned(), cause })?;
        learner.warm_start(&snapshot.values)?;
    }
    if !run.config.demonstrations.files.is_empty() {
        let message = demonstrate(&mut learner, run)?;
        supervisor.report(&Report::Warning { message })?;
    }
    Ok(learner)
}

/// Trains the learner on the configured demonstrations. Returns a summary for the user.
fn demonstrate(learner: &mut Learner, run: Run<'_>) -> Result<String, StartError> {
    let files = &run.config.demonstrations.files;
    let read = |file| Demonstration::read(Path::new(file), run.spec, learner.policy());
    let demonstrations = files.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    let losses = learner.demonstrate(&demonstrations)?;
    let summaries = demonstrations.iter().map(Demonstration::summary);
    let all = summaries.fold(DemonstrationSummary::default(), |sum, more| DemonstrationSummary {
        episodes: sum.episodes + more.episodes,
        steps: sum.steps + more.steps,
        rewards: sum.rewards + more.rewards,
    });
    let mean = all.rewards / all.episodes as f64;
    let shown =
        format!("{} demonstrated steps in {} episodes, return {mean:.2}", all.steps, all.episodes);
    Ok(match losses {
        None => shown,
        Some(CloningLosses { first, last }) => format!(
            "{shown}; the policy imitates them (mean squared error from {first:.3} to {last:.3})"
        ),
    })
}

/// Inserts the segments that were logged at `path` after the checkpoint, at delivery level `log`.
///
/// # Errors
/// If the log is unusable, or the supervisor is gone.
pub fn recover(
    learner: &mut Learner,
    run_id: u64,
    path: &Path,
    supervisor: &dyn Supervisor,
) -> Result<(), StartError> {
    let delivery = &learner.config().delivery;
    if delivery.level == DeliveryLevel::Memory {
        return Ok(());
    }
    let architecture_hash = learner.policy().architecture_hash();
    let identity = LogIdentity { run_id, architecture_hash };
    let log = SegmentLog::open(path, identity, learner.policy().layout(), delivery.log_bytes_max);
    let replayed = log.and_then(|log| learner.recover(log));
    let replayed = replayed.map_err(|cause| StartError::Log { path: path.to_owned(), cause })?;
    if replayed != Replayed::default() {
        let Replayed { records, cut_bytes } = replayed;
        let message = format!(
            "{records} segments read from the segment log, {cut_bytes} bytes of an incomplete \
             record cut off"
        );
        eprintln!("{message}");
        supervisor.report(&Report::Warning { message })?;
    }
    Ok(())
}
