//! The root of the configuration tree and the sections that are neither policy nor algorithm.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{AlgorithmConfig, DmpConfig, ExplorationConfig, PolicyConfig, StartSource};

/// One experiment: everything that decides what a run does.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ExperimentConfig {
    /// Length, seed and stopping rules.
    pub run: RunConfig,
    /// The environment.
    pub task: TaskConfig,
    /// From observation to actions.
    pub policy: PolicyConfig,
    /// The dynamic movement primitive.
    pub dmp: DmpConfig,
    /// The learning algorithm.
    pub algorithm: AlgorithmConfig,
    /// Departure from the policy in the rollout.
    pub exploration: ExplorationConfig,
    /// Storage of experience.
    pub replay: ReplayConfig,
    /// Experience of somebody else's.
    pub demonstrations: DemonstrationsConfig,
    /// Updates per inserted segment.
    pub pacing: PacingConfig,
    /// The rollout workers.
    pub actors: ActorsConfig,
    /// What a death may cost on the way from worker to learner.
    pub delivery: DeliveryConfig,
    /// Workers of other hosts (docs/several-hosts.md).
    pub bridge: BridgeConfig,
    /// What happens when a process dies or hangs.
    pub supervision: SupervisionConfig,
    /// The learner process.
    pub learner: LearnerConfig,
    /// Noise-free evaluation.
    pub evaluation: EvaluationConfig,
    /// What is kept on disk to go on from.
    pub checkpoint: CheckpointConfig,
    /// What is written about the run.
    pub metrics: MetricsConfig,
}

impl ExperimentConfig {
    /// Workers that there may be at once: the run's own, those that join, those of other hosts.
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
    /// Environment steps, all workers together.
    pub steps: u64,
    /// One worker, in one process with the learner and in lock-step with it: the same seed gives
    /// the same bytes. `actors.workers`, `actors.joined_max` and `bridge.listen` have no effect.
    pub deterministic: bool,
    /// Stop at the first evaluation whose mean return is this or more; inf: at none.
    pub until_return: f64,
    /// Stop at the first evaluation whose success rate, 0 to 1, is this or more; inf: at none.
    pub until_success: f64,
    /// Stop after so many minutes of wall clock, counted anew by `resume`; inf: never.
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
    /// The name typed on the command line.
    pub name: String,
    /// Gymnasium id, `Name-vN` or `module:Name-vN`, or a class, `module:Class`.
    pub id: String,
    /// Directories searched for the user's own environment modules.
    pub python_path: Vec<String>,
    /// Per action dimension, where y0 and yd0 stand in the observation; empty: not known.
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

/// Which goals an episode is repeated with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Hindsight {
    /// None but the one it had.
    None,
    /// Goals reached later in it (Andrychowicz et al. 2017, section 4.5).
    Future,
}

/// Storage of experience.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReplayConfig {
    /// Environment steps held, copies included; the oldest are replaced.
    pub capacity_steps: usize,
    /// Which goals the workers repeat their segments with, in goal-conditioned environments.
    pub hindsight: Hindsight,
    /// Copies of each segment, each with a goal of its own.
    pub hindsight_copies: usize,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        Self { capacity_steps: 1_000_000, hindsight: Hindsight::None, hindsight_copies: 4 }
    }
}

/// Experience that somebody recorded, from which a run starts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DemonstrationsConfig {
    /// Files of steps (docs/demonstrations.md).
    pub files: Vec<String>,
    /// Updates in which the actor imitates them, before anything else; 0: it does not.
    pub cloning_updates: u64,
    /// Environment steps after the warm-up over which imitation beside each update fades.
    pub imitation_steps: u64,
}

impl Default for DemonstrationsConfig {
    fn default() -> Self {
        Self { files: Vec::new(), cloning_updates: 1_000, imitation_steps: 30_000 }
    }
}

impl DemonstrationsConfig {
    /// Whether the run starts with a policy that imitates.
    #[must_use]
    pub fn are_cloned(&self) -> bool {
        !self.files.is_empty() && self.cloning_updates > 0
    }
}

/// Updates per inserted segment, and how far either side may run ahead.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PacingConfig {
    /// Updates per segment inserted after the warm-up: more learn more from each step, take longer,
    /// and may make the critic diverge.
    pub updates_per_segment: f64,
    /// Segments the learner may hold un-updated before it stops taking more, so that workers wait.
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
    /// Worker processes; 0 stands for cores - 1, at least 1.
    pub workers: usize,
    /// Workers that may join a running experiment (`dmprl actor --join RUN`) at once. Each has its
    /// queue from the start, whether it comes or not.
    pub joined_max: usize,
    /// Environments in each worker, which run a segment in one call.
    pub envs_per_worker: usize,
    /// Segments a worker's queue to the learner holds; full: the worker waits. 0 stands for
    /// `envs_per_worker`: with fewer a worker would wait for the learner in every segment.
    pub queue_segments: usize,
    /// A worker that waited so long on a full queue reports it, naming the learner \[s\].
    pub send_deadline_s: f64,
    /// Restarts of one worker before the run gives up on it. One that delivered segments for five
    /// minutes has them all again.
    pub restarts_max: u32,
    /// Failures of one environment, since it last completed an episode or 1 000 sound segments,
    /// that its worker makes up for by making it again; one more ends the worker, which is then
    /// restarted.
    pub env_failures_max: u32,
    /// One call into the environments (a segment in each of a worker's, or their reset) that lasts
    /// longer hangs: its process ends, the evaluator's too, and is restarted \[s\].
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
    /// Workers that there may be at once on the learner's host: its own, then those that join.
    #[must_use]
    pub fn places(&self) -> usize {
        self.workers.saturating_add(self.joined_max)
    }
}

/// Workers of other hosts, which `dmprl bridge` brings in.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BridgeConfig {
    /// Zenoh endpoints that other hosts connect to, such as `tcp/0.0.0.0:7447` or
    /// `tls/[::]:7447`; empty: the run stays on this host.
    pub listen: Vec<String>,
    /// Workers that other hosts may bring, all together. Each has its queue from the start, whether
    /// it comes or not.
    pub workers_max: usize,
    /// What a host may have on its way without the learner's acknowledgement \[bytes\]; full: its
    /// workers wait. At least the link's rate times its round trip, or it is never filled.
    pub under_way_bytes_max: u64,
    /// File with the secret that other hosts must know, readable by its owner alone; empty:
    /// `bridge.token` in the run's directory, which is made.
    pub token_file: String,
    /// A file of Zenoh's own configuration (JSON5) for certificates and access control; empty:
    /// neither.
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
    /// Whether other hosts may take part.
    #[must_use]
    pub fn is_open(&self) -> bool {
        !self.listen.is_empty()
    }

    /// Workers of other hosts that there may be at once.
    #[must_use]
    pub fn places(&self) -> usize {
        if self.is_open() { self.workers_max } else { 0 }
    }
}

/// When a worker may forget a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeliveryLevel {
    /// When the learner has inserted it: its death loses what came after its last checkpoint.
    Memory,
    /// When it is in the learner's segment log too: its death loses nothing.
    Log,
}

/// What a death may cost on the way from worker to learner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DeliveryConfig {
    /// When a worker may forget a segment.
    pub level: DeliveryLevel,
    /// Segments a worker keeps until the learner has acknowledged them; full: the worker waits. 0
    /// stands for `actors.queue_segments` and 1 024 more, which come in while an acknowledgement
    /// is on its way.
    pub unacknowledged_segments: usize,
    /// Size of the segment log \[bytes\]; full: a checkpoint is written, which empties it.
    pub log_bytes_max: u64,
}

impl Default for DeliveryConfig {
    fn default() -> Self {
        let level = DeliveryLevel::Memory;
        Self { level, unacknowledged_segments: 0, log_bytes_max: 1 << 30 }
    }
}

/// What happens when a process dies or hangs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SupervisionConfig {
    /// Restarts of a learner that was killed or crashed before the run ends. One that wrote a
    /// checkpoint and lived for five minutes has them all again.
    pub learner_restarts_max: u32,
    /// A worker that gives no sign of life for so long hangs: it is killed and restarted \[s\].
    pub heartbeat_timeout_s: f64,
}

impl Default for SupervisionConfig {
    fn default() -> Self {
        Self { learner_restarts_max: 5, heartbeat_timeout_s: 30.0 }
    }
}

/// Where the update runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Device {
    /// The processor.
    Cpu,
    /// An NVIDIA GPU, in a build with the feature `cuda`.
    Cuda,
}

/// What the products of an update multiply; sums and parameters are always f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// 32 bits.
    F32,
    /// 16 bits (bfloat16), on processors with AVX512-BF16: faster, to three digits.
    Bf16,
}

/// The learner process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LearnerConfig {
    /// Where the update runs.
    pub device: Device,
    /// Threads of the update; their number changes no bit of the result.
    pub threads: usize,
    /// What the update's products multiply.
    pub precision: Precision,
    /// Updates between two published parameter snapshots, which workers then act by.
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

/// Noise-free evaluation in its own process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationConfig {
    /// Environment steps between evaluations; one more always follows the last step.
    pub interval_steps: u64,
    /// Episodes of one evaluation.
    pub episodes: usize,
    /// Episodes of the evaluation at the end of the run, if that is more: results that are
    /// published need 100, and 100 in each evaluation would take longer than training.
    pub final_episodes: usize,
    /// Episode i is reset with seed first_seed + i, in every evaluation. Searches use 5000 and
    /// on, so that what they find is judged by episodes that they have not seen.
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

/// What is kept on disk to go on from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CheckpointConfig {
    /// Environment steps between checkpoints; one more always ends a run.
    pub interval_steps: u64,
    /// Checkpoints kept.
    pub keep: usize,
    /// Disk space all checkpoints of a run may take together \[bytes\]; at least one is kept.
    pub disk_bytes_max: u64,
}

impl Default for CheckpointConfig {
    fn default() -> Self {
        Self { interval_steps: 10_000, keep: 3, disk_bytes_max: 8 << 30 }
    }
}

/// What is written about the run.
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
