//! Messages between a supervisor and the processes that it starts.

use std::cmp::Ordering;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::spec::EnvSpec;
use crate::transport::delivery::Sent;

/// A command from the supervisor to a process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Command {
    /// To a worker: attach to the learner through this shared-memory directory.
    Attach {
        /// The run's private shared-memory directory.
        domain: PathBuf,
    },
    /// To the evaluator: evaluate this policy.
    Evaluate(EvaluationRequest),
    /// To the learner: number of environment failures.
    EnvFailures {
        /// Failures in the whole run, of all processes.
        total: u64,
    },
    /// To the learner: segment counts of all workers in the whole run.
    Sent(Sent),
    /// To the learner: state of the workers.
    Workers(WorkersNow),
    /// To the learner: the run has reached its goal or its time limit; finish with a last
    /// evaluation, as after the last step.
    Finish,
    /// To any process: save all state and exit.
    Stop,
}

/// A report from a process to the supervisor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Report {
    /// The environments of a worker or evaluator are ready.
    EnvironmentReady {
        /// Properties of the environments.
        spec: EnvSpec,
    },
    /// The learner is ready, and workers may attach.
    LearnerReady,
    /// The first segment of this run has reached the learner.
    FirstSegment,
    /// Progress of the learner, sent a few times per second.
    Progress(Progress),
    /// The learner requests an evaluation.
    Evaluate(EvaluationRequest),
    /// The evaluator has appended this row to `evaluations.jsonl`.
    Evaluated(EvaluationRow),
    /// An evaluation failed. The next one may succeed.
    NotEvaluated {
        /// Version of the policy.
        policy_version: u64,
        /// Description of the failure.
        reason: String,
    },
    /// Progress of the observer.
    Observed {
        /// Episodes recorded.
        episodes: u64,
        /// Steps of the next episode; 0 at the end of an episode.
        steps: u64,
    },
    /// Progress of a video.
    Filmed {
        /// Frames rendered.
        done: u64,
        /// Total number of frames.
        of: u64,
    },
    /// Environments failed and were recreated.
    EnvFailures {
        /// Number of failures since the previous report of this kind.
        count: u64,
        /// Description of the last failure.
        last: String,
    },
    /// A worker's segment counts since its previous report of this kind.
    Sent(Sent),
    /// A worker's heartbeat, once per second.
    Alive {
        /// Activity of the worker's loop.
        doing: Activity,
        /// Segments that the learner has not acknowledged.
        kept: u64,
    },
    /// A call into the environments has timed out. The process exits after this report.
    EnvHung {
        /// The message.
        message: String,
    },
    /// From the gateway, twice per second: the hosts that take part in the run.
    Hosts(Vec<HostNow>),
    /// A worker that joined the run leaves, after it has delivered as many of its segments as
    /// possible.
    Left,
    /// The learner wrote a checkpoint.
    Checkpoint {
        /// Name of its directory in `checkpoints/`.
        name: String,
        /// Environment steps inserted when it was written.
        env_steps: u64,
    },
    /// The learner has finished and written its last checkpoint.
    Finished,
    /// A warning for the user.
    Warning {
        /// The message.
        message: String,
    },
}

/// State of all workers, for the learner's metrics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorkersNow {
    /// Attached workers, including those that joined.
    pub count: u64,
    /// Restarts of workers in the whole run.
    pub restarts: u64,
    /// Unacknowledged segments of all workers.
    pub queued_segments: u64,
}

/// State of another host that takes part in the run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostNow {
    /// Name of the host.
    pub name: String,
    /// True if the host is reachable.
    pub here: bool,
    /// Attached workers of the host.
    pub workers: u64,
    /// Segments of its workers that the learner has not acknowledged.
    pub kept: u64,
    /// Segments of its workers that the learner has acknowledged.
    pub acked: u64,
    /// Restarts of its workers.
    pub restarts: u64,
}

/// Activity of a worker at a heartbeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activity {
    /// The worker waits for a learner or for its first policy.
    Attaching,
    /// The worker steps environments. The watchdog limits the duration of a call.
    Stepping,
    /// The worker waits because its queue or its outbox is full.
    Waiting,
}

impl Activity {
    /// Name of the activity, for messages.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Attaching => "waiting for a learner",
            Self::Stepping => "stepping environments",
            Self::Waiting => "waiting for the learner to take its segments",
        }
    }
}

/// Progress of the learner. All numbers are finite, because JSON has no NaN.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Environment steps inserted.
    pub env_steps: u64,
    /// Number of updates.
    pub updates: u64,
    /// Segments inserted.
    pub segments: u64,
    /// Recent rate of environment steps \[1/s\].
    pub env_steps_per_s: f64,
    /// Recent rate of updates \[1/s\].
    pub updates_per_s: f64,
    /// Mean return of recent training episodes, with exploration noise; null if there are none.
    pub return_mean: Option<f64>,
    /// Updates times batch size, divided by environment steps inserted.
    pub samples_per_insert: f64,
    /// Median policy lag of recent segments: policy versions between acting and insertion.
    pub policy_lag_p50: u64,
    /// Maximum policy lag of recent segments.
    pub policy_lag_max: u64,
    /// Unacknowledged segments of all workers.
    pub queued_segments: u64,
    /// Restarts of workers and learner in the whole run.
    pub restarts: u64,
    /// Segments rejected, not counting duplicates.
    pub rejected: u64,
    /// Environment failures.
    pub env_failures: u64,
}

/// A request to evaluate a policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationRequest {
    /// Environment steps inserted when the policy was saved.
    pub env_steps: u64,
    /// Updates done when the policy was saved.
    pub updates: u64,
    /// Segments inserted when the policy was saved.
    pub segments: u64,
    /// Training time when the policy was saved, over all sessions of the run \[s\].
    pub wall_s: f64,
    /// Version of the policy, saved as `policies/<version>.safetensors`.
    pub policy_version: u64,
}

/// One line of `evaluations.jsonl`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationRow {
    /// Environment steps inserted when the policy was saved.
    pub env_steps: u64,
    /// Updates done when the policy was saved.
    pub updates: u64,
    /// Segments inserted when the policy was saved.
    pub segments: u64,
    /// Training time when the policy was saved, over all sessions of the run \[s\].
    pub wall_s: f64,
    /// Version of the policy.
    pub policy_version: u64,
    /// Return of each episode.
    pub returns: Vec<f64>,
    /// Mean of the returns.
    pub return_mean: f64,
    /// Fraction of episodes that ended in success; null if the task does not report success.
    pub success_rate: Option<f64>,
    /// Mean |u_t - u_{t-1}| over all steps and action dimensions.
    pub smoothness: f64,
    /// Share of the actions that are within 1 % of a bound, over all steps and dimensions. `None`
    /// in rows of earlier versions.
    #[serde(default)]
    pub at_bounds: Option<f64>,
}

/// An evaluation contains a number that JSON cannot represent.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
#[error("evaluation of policy {policy_version}: expected finite numbers, got {number}")]
pub struct EvaluationNotFinite {
    /// Version of the policy.
    pub policy_version: u64,
    /// The first such number.
    pub number: f64,
}

impl EvaluationRow {
    /// Compares the policies by their success rates, and equal ones by their mean returns. With a
    /// sparse reward the return mostly says how soon the goal was reached.
    #[must_use]
    pub fn compare(&self, other: &Self) -> Ordering {
        let success_rate = |row: &Self| row.success_rate.unwrap_or(0.0);
        success_rate(self)
            .total_cmp(&success_rate(other))
            .then(self.return_mean.total_cmp(&other.return_mean))
    }

    /// Checks that JSON can represent the row.
    ///
    /// # Errors
    /// If a number is NaN or infinite.
    pub fn check_finite(&self) -> Result<(), EvaluationNotFinite> {
        let numbers = [self.wall_s, self.return_mean, self.smoothness];
        let mut numbers =
            numbers.iter().chain(&self.returns).chain(&self.success_rate).chain(&self.at_bounds);
        let policy_version = self.policy_version;
        match numbers.find(|number| !number.is_finite()) {
            Some(&number) => Err(EvaluationNotFinite { policy_version, number }),
            None => Ok(()),
        }
    }
}
