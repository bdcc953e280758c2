//! Messages between supervisor and roles: one JSON object per line, on the child's standard input
//! and output. A child's standard error is its log file.
//!
//! On end of input the supervisor is gone, and the child exits (the learner after a checkpoint). So
//! even SIGKILL of the supervisor leaves no orphans.

use std::fmt::{self, Display, Formatter};
use std::path::PathBuf;

use anyhow::ensure;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::Sent;
use serde::{Deserialize, Serialize};

/// Exit status of a process that exits because an environment call hung.
pub const ENV_HUNG_STATUS: i32 = 75;

/// Signals that a terminal or a service manager sends to the whole process group. Only the
/// supervisor handles them; roles ignore them.
pub const GROUP_SIGNALS: [i32; 3] = [libc::SIGINT, libc::SIGTERM, libc::SIGHUP];

/// Socket on which a run's supervisor accepts joining workers, in its private directory.
pub const JOIN_SOCKET: &str = "join.sock";
/// Version of the protocol between a supervisor and a joining worker. Children come from the same
/// build and do not check it.
const CONTROL_VERSION: u32 = 1;

/// Version of a program and its protocol, sent first by the supervisor.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Greeting {
    /// Version of the program.
    pub version: String,
    /// Version of the protocol.
    pub control: u32,
}

impl Greeting {
    /// The greeting of this program.
    #[must_use]
    pub fn this() -> Self {
        Self { version: env!("CARGO_PKG_VERSION").to_owned(), control: CONTROL_VERSION }
    }
}

impl Display for Greeting {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        write!(formatter, "dmprl {} (protocol {})", self.version, self.control)
    }
}

/// A worker's request to join.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JoinRequest {
    /// Version of the worker.
    pub speaks: Greeting,
}

/// The supervisor's answer to a request to join.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum JoinAnswer {
    /// The worker is admitted.
    Welcome(Welcome),
    /// The worker is rejected.
    Refused {
        /// The reason and a remedy.
        reason: String,
    },
}

/// Everything that an admitted worker needs to know.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Welcome {
    /// Index of the worker in the run.
    pub index: u32,
    /// Incarnation of the worker.
    pub incarnation: u32,
    /// The run's Python virtual environment.
    pub venv: Option<PathBuf>,
    /// Number of workers, including this one.
    pub workers: usize,
}

/// A message from the supervisor to a role.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Command {
    /// To a worker: the learner is ready, and its services are in this shared-memory directory.
    Attach {
        /// The run's private shared-memory directory.
        domain: PathBuf,
    },
    /// To the evaluator: evaluate this policy.
    Evaluate(EvaluationRequest),
    /// To the learner: number of failures of environments reported to the supervisor.
    EnvFailures {
        /// Total of all processes in the whole run.
        total: u64,
    },
    /// To the learner: total counts of segments that all workers have reported in the whole run.
    Sent(Sent),
    /// To the learner: state of the workers.
    Workers(WorkersNow),
    /// To the learner: the run has reached its goal or its time limit. Finish as after the last
    /// step, with a final evaluation.
    Finish,
    /// To any role: finish pending work and exit.
    Stop,
}

/// A message from a role to the supervisor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Report {
    /// A worker or the evaluator has created its environments.
    EnvironmentReady {
        /// Spec of the environments.
        spec: EnvSpec,
    },
    /// The learner's services exist, so workers may attach.
    LearnerReady,
    /// The first environment step of this run has reached the learner.
    FirstSegment,
    /// The learner's progress, sent several times per second.
    Progress(Progress),
    /// The learner requests an evaluation.
    Evaluate(EvaluationRequest),
    /// The evaluator's result: the row it appended to `evaluations.jsonl`.
    Evaluated(EvaluationRow),
    /// The evaluator's failure: the episodes of this evaluation failed; the next may succeed.
    NotEvaluated {
        /// Version of the requested policy.
        policy_version: u64,
        /// Description of the failure.
        reason: String,
    },
    /// Progress of the observer.
    Observed {
        /// Completed episodes.
        episodes: u64,
        /// Steps of the current episode; 0 if one has just ended.
        steps: u64,
    },
    /// Progress of the video.
    Filmed {
        /// Completed frames.
        done: u64,
        /// Total number of frames.
        of: u64,
    },
    /// Environments failed and were recreated.
    EnvFailures {
        /// Number of failures since the last such report.
        count: u64,
        /// The last failure: which environment, when and why.
        last: String,
    },
    /// Counts of a worker's segments since its last such report.
    Sent(Sent),
    /// A worker's heartbeat, once per second.
    Alive {
        /// Current activity.
        doing: Doing,
        /// Retained segments that the learner has not acknowledged.
        kept: u64,
    },
    /// A call into the environments does not return; the process exits after this message.
    EnvHung {
        /// Message for the user.
        message: String,
    },
    /// From the gateway, once per second: the participating hosts.
    Hosts(Vec<HostNow>),
    /// A joined worker leaves, after delivering as many segments as possible.
    Left,
    /// The learner wrote a checkpoint.
    Checkpoint {
        /// Name of its directory below `checkpoints/`.
        name: String,
        /// Environment steps in the checkpoint.
        env_steps: u64,
    },
    /// The learner has finished the run and written its last checkpoint.
    Finished,
    /// A warning for the user.
    Warning {
        /// Message for the user.
        message: String,
    },
}

/// The state of the workers, for the learner's metrics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorkersNow {
    /// Attached workers, both the run's own and joined ones.
    pub count: u64,
    /// Restarts after a death, in the whole run.
    pub restarts: u64,
    /// Segments that all workers retain until the learner acknowledges them.
    pub queued_segments: u64,
}

/// Another host that takes part in the run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostNow {
    /// Name of the host, for display.
    pub name: String,
    /// True if it is reachable.
    pub here: bool,
    /// Number of its attached workers.
    pub workers: u64,
    /// Segments that its workers retain until the learner acknowledges them.
    pub kept: u64,
    /// Segments of its workers that the learner has acknowledged.
    pub acked: u64,
    /// Restarts of its workers after a death.
    pub restarts: u64,
}

/// Activity of a worker, in its heartbeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Doing {
    /// Waits for a learner, or for its first policy.
    Attaching,
    /// Steps environments; the watchdog detects calls that hang.
    Stepping,
    /// Waits because its queue or its outbox is full.
    Waiting,
}

impl Doing {
    /// Description of the activity, as part of a sentence.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Attaching => "waiting for a learner",
            Self::Stepping => "stepping environments",
            Self::Waiting => "waiting for the learner to take its segments",
        }
    }
}

/// Progress of the learner. All numbers are finite, because JSON has no NaN, and a line with one
/// would be invalid.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Environment steps inserted.
    pub env_steps: u64,
    /// Updates done.
    pub updates: u64,
    /// Segments inserted.
    pub segments: u64,
    /// Recent environment steps per second.
    pub env_steps_per_s: f64,
    /// Recent updates per second.
    pub updates_per_s: f64,
    /// Mean return of the last training episodes (with noise); NaN is sent as null.
    pub return_mean: Option<f64>,
    /// Updates times batch size over environment steps inserted.
    pub samples_per_insert: f64,
    /// Median policy lag of recent segments, in policy versions between acting and insertion.
    pub policy_lag_p50: u64,
    /// Maximum policy lag of recent segments.
    pub policy_lag_max: u64,
    /// Segments that workers retain until the learner acknowledges them.
    pub queued_segments: u64,
    /// Restarts of workers and learner after a death, over the whole run.
    pub restarts: u64,
    /// Rejected segments, without duplicates.
    pub rejected: u64,
    /// Number of failures of environments.
    pub env_failures: u64,
}

/// Request for an evaluation.
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
    /// Mean of the returns.
    pub return_mean: f64,
    /// Fraction of successful episodes; null if the task does not report success.
    pub success_rate: Option<f64>,
    /// Mean |u_t - u_{t-1}| over all steps and action dimensions.
    pub smoothness: f64,
}

impl EvaluationRow {
    /// Rejects numbers that JSON cannot represent in `evaluations.jsonl` or in a report.
    ///
    /// # Errors
    /// A number is NaN or infinite.
    pub fn check_finite(&self) -> anyhow::Result<()> {
        let numbers = [self.wall_s, self.return_mean, self.smoothness];
        for number in numbers.iter().chain(&self.returns).chain(&self.success_rate) {
            ensure!(
                number.is_finite(),
                "evaluation of policy {}: expected finite numbers, got {number}",
                self.policy_version
            );
        }
        Ok(())
    }
}
