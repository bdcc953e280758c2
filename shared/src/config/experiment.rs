//! The root of the configuration, and all sections except task, policy, DMP, algorithm and learner.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{
    AlgorithmConfig, Backend, Device, DmpConfig, ExplorationConfig, LearnerConfig, PolicyConfig,
    TaskConfig,
};

/// Configuration of one experiment.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ExperimentConfig {
    /// Length, seed and stopping rules.
    pub run: RunConfig,
    /// The environment.
    pub task: TaskConfig,
    /// The policy, which maps an observation to actions.
    pub policy: PolicyConfig,
    /// The dynamic movement primitive.
    pub dmp: DmpConfig,
    /// The learning algorithm.
    pub algorithm: AlgorithmConfig,
    /// Exploration noise of the rollout.
    pub exploration: ExplorationConfig,
    /// The replay.
    pub replay: ReplayConfig,
    /// Recorded experience that a run starts from.
    pub demonstrations: DemonstrationsConfig,
    /// Ratio of updates to inserted segments.
    pub pacing: PacingConfig,
    /// The rollout workers.
    pub actors: ActorsConfig,
    /// Delivery of segments from worker to learner.
    pub delivery: DeliveryConfig,
    /// Workers on other hosts (docs/several-hosts.md).
    pub bridge: BridgeConfig,
    /// Handling of processes that crash or hang.
    pub supervision: SupervisionConfig,
    /// The learner process.
    pub learner: LearnerConfig,
    /// Noise-free evaluation.
    pub evaluation: EvaluationConfig,
    /// Checkpoints for `resume`.
    pub checkpoint: CheckpointConfig,
    /// Metrics of the run.
    pub metrics: MetricsConfig,
}

impl ExperimentConfig {
    /// Returns the maximum number of simultaneous workers: the run's own, those that join it, and
    /// those on other hosts.
    #[must_use]
    pub fn places(&self) -> usize {
        self.actors.places().saturating_add(self.bridge.places())
    }

    /// Returns true if there are kernels for the device and the algorithm.
    pub(super) fn has_kernels(&self) -> bool {
        self.learner.device == Device::Cpu && !self.algorithm.name.is_graph_only()
    }

    /// Returns true if updates are graphs, not kernels.
    #[must_use]
    pub fn updates_by_graph(&self) -> bool {
        match self.learner.backend {
            Backend::Graph => true,
            Backend::Kernels => false,
            Backend::Auto => !self.has_kernels(),
        }
    }
}

/// Length, seed and stopping rules.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RunConfig {
    /// Master seed, from which every random stream of the run is derived.
    pub seed: u64,
    /// Environment steps of all workers together.
    pub steps: u64,
    /// Runs one worker in the learner's process, in lock-step with the learner, so that the same
    /// seed gives bit-identical results. `actors.workers`, `actors.joined_max` and `bridge.listen`
    /// have no effect.
    pub deterministic: bool,
    /// Mean return at which the run stops, at the first evaluation that reaches it; inf: never.
    pub until_return: f64,
    /// Success rate (0 to 1) at which the run stops, at the first evaluation that reaches it; inf:
    /// never.
    pub until_success: f64,
    /// Wall-clock time after which the run stops \[min\]; inf: never. `resume` starts again from
    /// zero.
    pub max_minutes: f64,
}

impl Default for RunConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            steps: 60_000,
            deterministic: false,
            until_return: f64::INFINITY,
            until_success: f64::INFINITY,
            max_minutes: f64::INFINITY,
        }
    }
}

/// Goals that experience is relabelled with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Hindsight {
    /// No hindsight.
    None,
    /// Goals reached later in the episode (Andrychowicz et al. 2017, section 4.5).
    Future,
    /// The goal reached at the end of the episode.
    Final,
    /// Goals reached at any step of the episode.
    Episode,
}

/// The replay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReplayConfig {
    /// Capacity in environment steps, with hindsight copies. When full, the oldest are overwritten.
    pub capacity_steps: usize,
    /// Goals of hindsight experience replay. Needs a goal-conditioned environment. If its rewards
    /// follow a rule, goals are drawn anew whenever a batch is sampled; otherwise workers make
    /// copies of their segments.
    pub hindsight: Hindsight,
    /// Share of a batch's windows that get another goal, if it is drawn when a batch is sampled.
    pub hindsight_share: f64,
    /// Share of these windows that get the desired goal of another episode, instead of a goal that
    /// their own episode reached. Such goals show a policy where it does not succeed.
    pub other_goals_share: f64,
    /// Share of the reached goals that are moved by a random part of the way by which another
    /// episode of the replay missed its goal. Such goals show the critics where success ends.
    pub near_misses_share: f64,
    /// Share of a batch's windows that come from episodes in which the achieved goal moved and
    /// stayed in the region of desired goals and starts, if goals are drawn when a batch is sampled
    /// and the reward is sparse. Where few episodes did, the share may be smaller. While a
    /// coordinate of the goals is unreached, half of them come from episodes that went away in it
    /// (docs/algorithm.md).
    pub moved_share: f64,
    /// Hindsight copies per segment, each with its own goal, if workers make copies.
    pub hindsight_copies: usize,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        Self {
            capacity_steps: 1_000_000,
            hindsight: Hindsight::None,
            hindsight_share: 0.8,
            other_goals_share: 0.0,
            near_misses_share: 0.0,
            moved_share: 0.0,
            hindsight_copies: 4,
        }
    }
}

/// Recorded experience that a run starts from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DemonstrationsConfig {
    /// Files with recorded steps (docs/demonstrations.md).
    pub files: Vec<String>,
    /// Behaviour-cloning updates of the actor before training starts; 0: none.
    pub cloning_updates: u64,
    /// Environment steps after the warm-up over which the imitation term of the actor's updates
    /// falls linearly to zero.
    pub imitation_steps: u64,
    /// Share of the sampled windows that come from the demonstrations, in addition to those that
    /// are drawn from all of the replay.
    pub share: f64,
}

impl Default for DemonstrationsConfig {
    fn default() -> Self {
        Self { files: Vec::new(), cloning_updates: 1_000, imitation_steps: 30_000, share: 0.1 }
    }
}

impl DemonstrationsConfig {
    /// Whether the run starts with behaviour cloning.
    #[must_use]
    pub fn are_cloned(&self) -> bool {
        !self.files.is_empty() && self.cloning_updates > 0
    }
}

/// Ratio of updates to inserted segments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PacingConfig {
    /// Updates per segment inserted after the warm-up. With more updates a run needs fewer
    /// environment steps but more time, and the critic can diverge.
    pub updates_per_segment: f64,
    /// Number of inserted segments with pending updates at which the learner stops receiving, so
    /// that workers wait.
    pub tolerance_segments: u64,
}

impl Default for PacingConfig {
    fn default() -> Self {
        Self { updates_per_segment: 2.0, tolerance_segments: 16 }
    }
}

/// The rollout workers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ActorsConfig {
    /// Worker processes; 0 means cores - 1, at least 1.
    pub workers: usize,
    /// Maximum number of simultaneous workers that have joined the running experiment
    /// (`dmprl actor --join RUN`). Their queues are reserved at the start of the run.
    pub joined_max: usize,
    /// Environments per worker. One call runs a segment in all of them.
    pub envs_per_worker: usize,
    /// Capacity of a worker's queue to the learner \[segments\]. A worker waits while its queue is
    /// full. 0 means `envs_per_worker`; with a smaller queue, a worker waits for the learner at
    /// every segment.
    pub queue_segments: usize,
    /// Time that a worker waits on a full queue before it reports that the learner is slow \[s\].
    pub send_deadline_s: f64,
    /// Maximum number of restarts of one worker; after that the run continues without it. The count
    /// is reset once the worker has delivered segments for five minutes.
    pub restarts_max: u32,
    /// Maximum number of failures of one environment. Up to this number, the worker recreates the
    /// environment; on one more, the worker exits and is restarted. The count is reset after a
    /// completed episode, or after 1 000 valid segments since the first counted failure.
    pub env_failures_max: u32,
    /// Timeout of one call into the environments, which runs or resets all environments of a worker
    /// \[s\]. On a timeout the worker or evaluator exits and is restarted.
    pub env_call_timeout_s: f64,
}

impl Default for ActorsConfig {
    fn default() -> Self {
        Self {
            workers: 0,
            joined_max: 4,
            envs_per_worker: 8,
            queue_segments: 0,
            send_deadline_s: 30.0,
            restarts_max: 5,
            env_failures_max: 10,
            env_call_timeout_s: 60.0,
        }
    }
}

impl ActorsConfig {
    /// Returns the maximum number of simultaneous workers on the learner's host, including those
    /// that join.
    #[must_use]
    pub fn places(&self) -> usize {
        self.workers.saturating_add(self.joined_max)
    }
}

/// Workers on other hosts, which connect with `dmprl bridge`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BridgeConfig {
    /// Zenoh endpoints on which the run accepts other hosts, such as `tls/0.0.0.0:7447` or
    /// `tls/[::]:7447`; empty: the run accepts no other host.
    pub listen: Vec<String>,
    /// Whether `bridge.listen` may contain `tcp/` endpoints beyond loopback. Their messages are
    /// authenticated, but others on the network can read them.
    pub allow_plain: bool,
    /// Maximum number of workers on all other hosts together. Their queues are reserved at the
    /// start of the run.
    pub workers_max: usize,
    /// Maximum amount of unacknowledged data per host \[bytes\]. At the limit, the host's workers
    /// wait. A limit below the link's rate times its round-trip time leaves the link partly idle.
    pub under_way_bytes_max: u64,
    /// File with the secret that other hosts must know. Only its owner may have access to it.
    /// Empty: `bridge.token`, which is created in the run's directory.
    pub token_file: String,
    /// Zenoh configuration file (JSON5), for certificates and access control; empty: none.
    pub zenoh_file: String,
}

impl Default for BridgeConfig {
    fn default() -> Self {
        Self {
            listen: Vec::new(),
            allow_plain: false,
            workers_max: 16,
            under_way_bytes_max: 64 << 20,
            token_file: String::new(),
            zenoh_file: String::new(),
        }
    }
}

impl BridgeConfig {
    /// Whether other hosts may connect.
    #[must_use]
    pub fn is_open(&self) -> bool {
        !self.listen.is_empty()
    }

    /// Returns the maximum number of simultaneous workers on other hosts.
    #[must_use]
    pub fn places(&self) -> usize {
        if self.is_open() { self.workers_max } else { 0 }
    }
}

/// Point at which a worker discards its copy of a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeliveryLevel {
    /// After the learner has inserted it. A crash of the learner loses the segments since its last
    /// checkpoint.
    Memory,
    /// After it is also in the learner's segment log. A crash of the learner loses no segment.
    Log,
}

/// Delivery of segments from worker to learner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DeliveryConfig {
    /// Point at which a worker discards its copy of a segment.
    pub level: DeliveryLevel,
    /// Maximum number of unacknowledged segments that a worker keeps. At the limit, the worker
    /// waits. 0 means `actors.queue_segments` plus 1 024 for segments that are sent before an
    /// acknowledgement arrives.
    pub unacknowledged_segments: usize,
    /// Maximum size of the segment log \[bytes\]. A full log triggers a checkpoint, which empties
    /// the log.
    pub log_bytes_max: u64,
}

impl Default for DeliveryConfig {
    fn default() -> Self {
        let level = DeliveryLevel::Memory;
        Self { level, unacknowledged_segments: 0, log_bytes_max: 1 << 30 }
    }
}

/// Handling of processes that crash or hang.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SupervisionConfig {
    /// Maximum number of restarts of a killed or crashed learner; after that the run fails. The
    /// count is reset once the learner has run for five minutes and written a checkpoint.
    pub learner_restarts_max: u32,
    /// Time without a heartbeat after which a worker is killed and restarted \[s\].
    pub heartbeat_timeout_s: f64,
    /// Time without a report of progress after which the learner is killed and replaced from its
    /// last checkpoint \[s\]. The learner reports twice a second, also while it waits for workers
    /// or for a slow disk.
    pub learner_timeout_s: f64,
}

impl Default for SupervisionConfig {
    fn default() -> Self {
        Self { learner_restarts_max: 5, heartbeat_timeout_s: 30.0, learner_timeout_s: 120.0 }
    }
}

/// Noise-free evaluation in a separate process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationConfig {
    /// Environment steps between evaluations. One more evaluation follows the last step.
    pub interval_steps: u64,
    /// Episodes per evaluation.
    pub episodes: usize,
    /// Episodes of the final evaluation, after `run.steps`; ignored if less than `episodes`.
    /// Published results need 100, which would take longer than training in every evaluation. A
    /// run that stops earlier, at its goal or time limit, does not use this.
    pub final_episodes: usize,
    /// Seed of the first episode: every evaluation resets episode i with seed first_seed + i.
    /// Searches use seeds from 5000, so that published evaluations use unseen episodes.
    pub first_seed: u64,
}

impl Default for EvaluationConfig {
    fn default() -> Self {
        Self { interval_steps: 5_000, episodes: 20, final_episodes: 0, first_seed: 1_000 }
    }
}

impl EvaluationConfig {
    /// Returns the number of episodes of an evaluation after `env_steps` in a run of `run_steps`.
    #[must_use]
    pub fn episodes_at(&self, env_steps: u64, run_steps: u64) -> usize {
        if env_steps >= run_steps { self.episodes_max() } else { self.episodes }
    }

    /// Returns the number of episodes of the longest evaluation.
    #[must_use]
    pub fn episodes_max(&self) -> usize {
        self.episodes.max(self.final_episodes)
    }
}

/// Checkpoints for `resume`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CheckpointConfig {
    /// Environment steps between checkpoints. One more is written at the end of a run.
    pub interval_steps: u64,
    /// Number of checkpoints to keep.
    pub keep: usize,
    /// Maximum disk space for all checkpoints of a run \[bytes\]. At least one checkpoint is kept,
    /// even if it is larger.
    pub disk_bytes_max: u64,
}

impl Default for CheckpointConfig {
    fn default() -> Self {
        Self { interval_steps: 10_000, keep: 3, disk_bytes_max: 8 << 30 }
    }
}

/// Metrics of the run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MetricsConfig {
    /// Environment steps between two lines of `metrics.jsonl`.
    pub interval_steps: u64,
}

impl Default for MetricsConfig {
    fn default() -> Self {
        Self { interval_steps: 1_000 }
    }
}
