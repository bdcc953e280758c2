//! The root of the configuration tree and the sections that are neither policy nor algorithm.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{AlgorithmConfig, DmpConfig, ExplorationConfig, PolicyConfig, StartSource};

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
    /// Recorded experience from other sources.
    pub demonstrations: DemonstrationsConfig,
    /// Updates per inserted segment.
    pub pacing: PacingConfig,
    /// The rollout workers.
    pub actors: ActorsConfig,
    /// Guarantees for segments on their way from worker to learner.
    pub delivery: DeliveryConfig,
    /// Workers on other hosts (docs/several-hosts.md).
    pub bridge: BridgeConfig,
    /// Reaction to processes that die or hang.
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
    /// Maximum number of simultaneous workers: the run's own, joined ones and those on other hosts.
    #[must_use]
    pub fn places(&self) -> usize {
        self.actors.places().saturating_add(self.bridge.places())
    }
}

/// Length, seed and stopping rules. An infinite bound never stops a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RunConfig {
    /// Master seed; every random stream of the run derives from it.
    pub seed: u64,
    /// Environment steps of all workers together.
    pub steps: u64,
    /// One worker, in one process with the learner and in lock-step with it: the same seed gives
    /// the same bytes. `actors.workers`, `actors.joined_max` and `bridge.listen` have no effect.
    pub deterministic: bool,
    /// Stop at the first evaluation with at least this mean return; inf: never.
    pub until_return: f64,
    /// Stop at the first evaluation with at least this success rate (0 to 1); inf: never.
    pub until_success: f64,
    /// Stop after this many minutes of wall-clock time, which `resume` counts from zero; inf:
    /// never.
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

/// The environment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TaskConfig {
    /// Name of the task on the command line.
    pub name: String,
    /// Gymnasium id (`Name-vN` or `module:Name-vN`), or a class (`module:Class`).
    pub id: String,
    /// Directories that are searched for your own environment modules.
    pub python_path: Vec<String>,
    /// Entries of the observation that give y0 and yd0, one source per action dimension; empty:
    /// unknown.
    pub start_sources: Vec<StartSource>,
}

impl Default for TaskConfig {
    fn default() -> Self {
        Self {
            name: "reacher".into(),
            id: "Reacher-v5".into(),
            python_path: Vec::new(),
            start_sources: Vec::new(),
        }
    }
}

/// Goals of an episode's copies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Hindsight {
    /// No copies.
    None,
    /// Goals reached later in the episode (Andrychowicz et al. 2017, section 4.5).
    Future,
}

/// The replay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReplayConfig {
    /// Capacity in environment steps, hindsight copies included; the oldest are overwritten.
    pub capacity_steps: usize,
    /// Goals of the copies that workers make of their segments, in goal-conditioned environments.
    pub hindsight: Hindsight,
    /// Copies of each segment, each with a different goal.
    pub hindsight_copies: usize,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        Self { capacity_steps: 1_000_000, hindsight: Hindsight::None, hindsight_copies: 4 }
    }
}

/// Recorded experience that a run starts from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DemonstrationsConfig {
    /// Files of recorded steps (docs/demonstrations.md).
    pub files: Vec<String>,
    /// Updates in which the actor imitates the demonstrations before training starts; 0: none.
    pub cloning_updates: u64,
    /// Environment steps after the warm-up over which the imitation term of the updates fades out.
    pub imitation_steps: u64,
}

impl Default for DemonstrationsConfig {
    fn default() -> Self {
        Self { files: Vec::new(), cloning_updates: 1_000, imitation_steps: 30_000 }
    }
}

impl DemonstrationsConfig {
    /// Whether the run starts with a cloned policy.
    #[must_use]
    pub fn are_cloned(&self) -> bool {
        !self.files.is_empty() && self.cloning_updates > 0
    }
}

/// Updates per inserted segment, and how far workers and learner may drift apart.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PacingConfig {
    /// Updates per segment inserted after the warm-up. More updates learn more from each step but
    /// take longer, and can make the critic diverge.
    pub updates_per_segment: f64,
    /// Segments with pending updates at which the learner stops receiving, so that workers wait.
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
    /// Maximum number of workers that take part in a running experiment by joining it
    /// (`dmprl actor --join RUN`), at any one time. Their queues are reserved at the start of the
    /// run.
    pub joined_max: usize,
    /// Environments per worker; one call runs a segment in all of them.
    pub envs_per_worker: usize,
    /// Capacity of a worker's queue to the learner; a worker waits while it is full. 0 means
    /// `envs_per_worker`; with less, a worker would wait for the learner in every segment.
    pub queue_segments: usize,
    /// Wait on a full queue after which a worker reports that the learner is slow \[s\].
    pub send_deadline_s: f64,
    /// Restarts of one worker before the run continues without it. Delivering segments for five
    /// minutes resets the count.
    pub restarts_max: u32,
    /// Environment failures that a worker tolerates by recreating the environment. The count is per
    /// environment and restarts after a completed episode or 1 000 valid segments. One more failure
    /// ends the worker, which is then restarted.
    pub env_failures_max: u32,
    /// Timeout of one call into the environments (a segment in each of a worker's environments, or
    /// their reset) \[s\]. On a timeout the worker or evaluator exits and is restarted.
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
    /// Maximum number of simultaneous workers on the learner's host: its own and joined ones.
    #[must_use]
    pub fn places(&self) -> usize {
        self.workers.saturating_add(self.joined_max)
    }
}

/// Workers on other hosts, which connect with `dmprl bridge`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BridgeConfig {
    /// Zenoh endpoints that accept other hosts, such as `tcp/0.0.0.0:7447` or `tls/[::]:7447`;
    /// empty: the run uses one host.
    pub listen: Vec<String>,
    /// Maximum number of workers on all other hosts together. Their queues are reserved at the
    /// start of the run.
    pub workers_max: usize,
    /// Maximum amount of unacknowledged data per host \[bytes\]; its workers wait while it is
    /// reached. Set it to at least the link's rate times its round trip, or the link is never fully
    /// used.
    pub under_way_bytes_max: u64,
    /// File with the secret that other hosts must present, readable only by its owner; empty:
    /// `bridge.token` is created in the run's directory.
    pub token_file: String,
    /// File of Zenoh's own configuration (JSON5), for certificates and access control; empty: none.
    pub zenoh_file: String,
}

impl Default for BridgeConfig {
    fn default() -> Self {
        Self {
            listen: Vec::new(),
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

    /// Maximum number of simultaneous workers on other hosts.
    #[must_use]
    pub fn places(&self) -> usize {
        if self.is_open() { self.workers_max } else { 0 }
    }
}

/// When a worker discards a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeliveryLevel {
    /// After the learner has inserted it. A learner that dies loses the segments since its last
    /// checkpoint.
    Memory,
    /// After it is also in the learner's segment log. A learner that dies loses nothing.
    Log,
}

/// Guarantees for segments on their way from worker to learner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DeliveryConfig {
    /// When a worker discards a segment.
    pub level: DeliveryLevel,
    /// Unacknowledged segments that a worker keeps; it waits when this many are kept. 0 means
    /// `actors.queue_segments` plus 1 024, for segments sent while an acknowledgement is on its
    /// way.
    pub unacknowledged_segments: usize,
    /// Maximum size of the segment log \[bytes\]. A full log triggers a checkpoint, which empties
    /// it.
    pub log_bytes_max: u64,
}

impl Default for DeliveryConfig {
    fn default() -> Self {
        let level = DeliveryLevel::Memory;
        Self { level, unacknowledged_segments: 0, log_bytes_max: 1 << 30 }
    }
}

/// Reaction to processes that die or hang.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SupervisionConfig {
    /// Restarts of a killed or crashed learner before the run fails. Writing a checkpoint and
    /// living for five minutes resets the count.
    pub learner_restarts_max: u32,
    /// Heartbeat timeout of a worker \[s\]; after it the worker is killed and restarted.
    pub heartbeat_timeout_s: f64,
}

impl Default for SupervisionConfig {
    fn default() -> Self {
        Self { learner_restarts_max: 5, heartbeat_timeout_s: 30.0 }
    }
}

/// Device of the update.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Device {
    /// The CPU.
    Cpu,
    /// An NVIDIA GPU, in a build with the feature `cuda`.
    Cuda,
}

/// Precision of the products in an update; sums and parameters are always f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// 32 bits.
    F32,
    /// 16 bits (bfloat16), on processors with AVX512-BF16: faster, with three significant digits.
    Bf16,
}

/// The learner process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LearnerConfig {
    /// Device of the update.
    pub device: Device,
    /// Threads of the update; the result is bit-identical for every number.
    pub threads: usize,
    /// Precision of the products in an update; sums and parameters are always f32.
    pub precision: Precision,
    /// Updates between two published parameter snapshots.
    pub publish_every_updates: u64,
}

impl Default for LearnerConfig {
    fn default() -> Self {
        Self {
            device: Device::Cpu,
            threads: 1,
            precision: Precision::F32,
            publish_every_updates: 4,
        }
    }
}

/// Noise-free evaluation in a separate process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationConfig {
    /// Environment steps between evaluations; one more follows the last step.
    pub interval_steps: u64,
    /// Episodes per evaluation.
    pub episodes: usize,
    /// Episodes of the evaluation after the last step of `run.steps`, if that is more than
    /// `episodes`. Published results need 100; 100 in each evaluation would take longer than
    /// training. A run that stops earlier, at its goal or time limit, ends with `episodes`.
    pub final_episodes: usize,
    /// Seed of the first episode: every evaluation resets episode i with seed first_seed + i.
    /// Searches use seeds from 5000, so that their results are evaluated on unseen episodes.
    pub first_seed: u64,
}

impl Default for EvaluationConfig {
    fn default() -> Self {
        Self { interval_steps: 5_000, episodes: 20, final_episodes: 0, first_seed: 1_000 }
    }
}

impl EvaluationConfig {
    /// Episodes of an evaluation after `env_steps` of a run of `run_steps`.
    #[must_use]
    pub fn episodes_at(&self, env_steps: u64, run_steps: u64) -> usize {
        if env_steps >= run_steps { self.episodes_max() } else { self.episodes }
    }

    /// Episodes of the longest evaluation.
    #[must_use]
    pub fn episodes_max(&self) -> usize {
        self.episodes.max(self.final_episodes)
    }
}

/// Checkpoints for `resume`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CheckpointConfig {
    /// Environment steps between checkpoints; one more is written at the end of a run.
    pub interval_steps: u64,
    /// Number of checkpoints that are kept.
    pub keep: usize,
    /// Maximum disk space for all checkpoints of a run \[bytes\]; at least one is kept.
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
