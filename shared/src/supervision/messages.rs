//! What a supervisor and the processes that it starts say to each other.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::spec::EnvSpec;
use crate::transport::delivery::Sent;

/// From the supervisor to a role.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Command {
    /// To a worker: the learner is up, its services lie in this shared-memory directory.
    Attach {
        /// The run's private shared-memory directory.
        domain: PathBuf,
    },
    /// To the evaluator: evaluate this policy.
    Evaluate(EvaluationRequest),
    /// To the learner: so many failures of environments have been reported to the supervisor.
    EnvFailures {
        /// In the whole run, all processes together.
        total: u64,
    },
    /// To the learner: what all workers have reported to the supervisor, in the whole run.
    Sent(Sent),
    /// To the learner: what the supervisor knows of the workers.
    Workers(WorkersNow),
    /// To the learner: the run has reached its goal or its time; finish as at the last step, with a
    /// last evaluation.
    Finish,
    /// To any role: finish what must be finished and exit.
    Stop,
}

/// From a role to the supervisor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Report {
    /// A worker or the evaluator has its environments.
    EnvironmentReady {
        /// What they are.
        spec: EnvSpec,
    },
    /// The learner's services exist: workers may attach.
    LearnerReady,
    /// The first environment step of this run has reached the learner.
    FirstSegment,
    /// Where the learner stands; a few times a second.
    Progress(Progress),
    /// The learner asks for an evaluation.
    Evaluate(EvaluationRequest),
    /// The evaluator's answer: the row it appended to `evaluations.jsonl`.
    Evaluated(EvaluationRow),
    /// The evaluator's other answer: the episodes of this evaluation failed; the next may succeed.
    NotEvaluated {
        /// Which policy was asked for.
        policy_version: u64,
        /// What failed.
        reason: String,
    },
    /// How far the observer is.
    Observed {
        /// Episodes written down.
        episodes: u64,
        /// Steps of the next one; 0 when an episode has just ended.
        steps: u64,
    },
    /// How far the video is.
    Filmed {
        /// Frames in it.
        done: u64,
        /// How many there will be.
        of: u64,
    },
    /// Environments failed and were made again.
    EnvFailures {
        /// How many times since the last such report.
        count: u64,
        /// The last of them: which, when and why.
        last: String,
    },
    /// What a worker did since its last such report.
    Sent(Sent),
    /// A worker's sign of life, once a second.
    Alive {
        /// What it does.
        doing: Activity,
        /// Segments that it keeps because the learner has not acknowledged them.
        kept: u64,
    },
    /// A call into the environments does not return; the process ends itself after this.
    EnvHung {
        /// The sentence.
        message: String,
    },
    /// From the gateway, once a second: the hosts that take part.
    Hosts(Vec<HostNow>),
    /// A worker that had joined leaves; it has handed over what it could.
    Left,
    /// The learner wrote a checkpoint.
    Checkpoint {
        /// Its directory's name below `checkpoints/`.
        name: String,
        /// Environment steps in it.
        env_steps: u64,
    },
    /// The learner has come to its end and written its last checkpoint.
    Finished,
    /// A role noticed something the user should read.
    Warning {
        /// The sentence.
        message: String,
    },
}

/// What the supervisor tells the learner of the workers, for its metrics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorkersNow {
    /// Attached: the run's own and those that have joined.
    pub count: u64,
    /// Starts after a death, in the whole run.
    pub restarts: u64,
    /// Segments that they keep until the learner acknowledges them, all together.
    pub queued_segments: u64,
}

/// Another host that takes part in the run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostNow {
    /// What people call it.
    pub name: String,
    /// Whether it can be reached.
    pub here: bool,
    /// Workers that it has attached.
    pub workers: u64,
    /// Segments that they keep until the learner acknowledges them.
    pub kept: u64,
    /// Segments of theirs that the learner has acknowledged.
    pub acked: u64,
    /// Starts of its workers after a death.
    pub restarts: u64,
}

/// What a worker does when it gives a sign of life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activity {
    /// It waits for a learner, or for its first policy.
    Attaching,
    /// It steps environments; what a call into them does is the watchdog's business.
    Stepping,
    /// It waits because its queue or its outbox is full.
    Waiting,
}

impl Activity {
    /// As part of a sentence.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Attaching => "waiting for a learner",
            Self::Stepping => "stepping environments",
            Self::Waiting => "waiting for the learner to take its segments",
        }
    }
}

/// Where the learner stands. Every number is finite: JSON has no NaN, and a line with one is no
/// report.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Environment steps inserted.
    pub env_steps: u64,
    /// Updates done.
    pub updates: u64,
    /// Segments inserted.
    pub segments: u64,
    /// Environment steps per second, lately.
    pub env_steps_per_s: f64,
    /// Updates per second, lately.
    pub updates_per_s: f64,
    /// Mean return of the last training episodes (with noise); NaN is sent as null.
    pub return_mean: Option<f64>,
    /// Updates times batch size over environment steps inserted.
    pub samples_per_insert: f64,
    /// Median over recent segments: policy versions between acting and insertion.
    pub policy_lag_p50: u64,
    /// Largest of them.
    pub policy_lag_max: u64,
    /// Segments that workers keep until the learner acknowledges them.
    pub queued_segments: u64,
    /// Starts of workers and of the learner after a death, over the whole run.
    pub restarts: u64,
    /// Segments refused, duplicates aside.
    pub rejected: u64,
    /// Failures of environments.
    pub env_failures: u64,
}

/// One evaluation to be done.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationRequest {
    /// Environment steps inserted when the policy was saved.
    pub env_steps: u64,
    /// Updates done by then.
    pub updates: u64,
    /// Segments inserted by then.
    pub segments: u64,
    /// Seconds of training by then, over all sessions of the run.
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
    /// Updates done by then.
    pub updates: u64,
    /// Segments inserted by then.
    pub segments: u64,
    /// Seconds of training by then, over all sessions of the run.
    pub wall_s: f64,
    /// Version of the policy.
    pub policy_version: u64,
    /// Return of each episode.
    pub returns: Vec<f64>,
    /// Their mean.
    pub return_mean: f64,
    /// Share of episodes that ended in success; null where the task does not report it.
    pub success_rate: Option<f64>,
    /// Mean |u_t - u_{t-1}| over all steps and action dimensions.
    pub smoothness: f64,
}

/// An evaluation with a number that JSON cannot represent.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
#[error("evaluation of policy {policy_version}: expected finite numbers, got {number}")]
pub struct EvaluationNotFinite {
    /// Version of the policy.
    pub policy_version: u64,
    /// The first such number.
    pub number: f64,
}

impl EvaluationRow {
    /// Rejects a row that JSON cannot represent: neither `evaluations.jsonl` nor a report holds it.
    ///
    /// # Errors
    /// A number is NaN or infinite.
    pub fn check_finite(&self) -> Result<(), EvaluationNotFinite> {
        let numbers = [self.wall_s, self.return_mean, self.smoothness];
        let mut numbers = numbers.iter().chain(&self.returns).chain(&self.success_rate);
        let policy_version = self.policy_version;
        match numbers.find(|number| !number.is_finite()) {
            Some(&number) => Err(EvaluationNotFinite { policy_version, number }),
            None => Ok(()),
        }
    }
}
