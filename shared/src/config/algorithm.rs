//! Configuration of the learning algorithm and of exploration.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::AlgorithmName;

/// Actions that the critic sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CriticInput {
    /// Q(s_t, u_t .. u_{t+K-1}).
    Segment,
    /// Q(s_t, u_t), as in the paper; only with `windows = "segment"`.
    First,
}

/// K-step windows of the replay that are used as samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Windows {
    /// Every window of K steps inside an episode.
    Sliding,
    /// Only windows that begin at the start of a segment.
    Segment,
}

/// The critic's regression target.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// sum_{k<n} discount^k r_{t+k} + discount^n (1 - terminated) Q'(s_{t+n}, pi'(s_{t+n})).
    NStep,
    /// sum of the K rewards + discount (1 - terminated) Q'(s_{t+1}, pi'(s_{t+1})), as in the paper.
    Literal,
}

/// The return after an episode that reached its time limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum AfterTimeLimit {
    /// Q'(s_T, pi'(s_T)), as if the episode continued (Pardo et al. 2018, arXiv 1712.00378).
    Bootstrap,
    /// r_T / (1 - discount), the return of the last reward in every further step, so that the end
    /// of an episode counts most.
    LastReward,
}

/// The learning algorithm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AlgorithmConfig {
    /// Algorithm that updates the networks.
    pub name: AlgorithmName,
    /// Actions that the critic sees.
    pub critic: CriticInput,
    /// K-step windows of the replay that are used as samples.
    pub windows: Windows,
    /// The critic's regression target.
    pub target: Target,
    /// The return after an episode that reached its time limit. `last_reward` is for tasks where
    /// only the end of an episode counts. It needs `target = "n_step"` and a discount below 1 (not
    /// with `ndp`).
    pub after_time_limit: AfterTimeLimit,
    /// Discount per environment step.
    pub discount: f64,
    /// Target smoothing: target <- polyak * network + (1 - polyak) * target.
    pub polyak: f64,
    /// Adam step size of the critic.
    pub critic_learning_rate: f64,
    /// Adam step size of the actor.
    pub actor_learning_rate: f64,
    /// Windows per update.
    pub batch_size: usize,
    /// Widths of the critic's hidden layers.
    pub critic_hidden: Vec<usize>,
    /// Applies layer normalisation (Ba et al. 2016) to the critic's hidden layers, before their
    /// ReLU, in all but `ndp`. It bounds Q for actions unlike any in the replay (Ball et al.
    /// 2023).
    pub critic_layer_norm: bool,
    /// Weight of a penalty on the action rate in the actor's loss (not with `ndp`). The penalty
    /// is the sum of (u_t - u_{t-1})² over a decision's noise-free actions and their dimensions.
    /// The weight is relative to the batch's mean |Q|, so it does not depend on the scale of the
    /// rewards. The action before the first one is read from the replay. Larger values give
    /// smoother motion.
    pub action_rate_penalty: f64,
    /// The same for the action acceleration: the penalty is the sum of
    /// (u_{t+1} - 2 u_t + u_{t-1})². Actions before the first one are read from the replay.
    pub action_acceleration_penalty: f64,
    /// Reward that a step loses for each unit of jerk, when a batch is sampled (not with `ndp`).
    /// The jerk is the mean |v_{t+1} - 2 v_t + v_{t-1}| / dt² over the velocities of
    /// `task.start_sources` \[rad/s³ or m/s³\], where dt is the time of a step, or 1 if the
    /// environment does not report it. Evaluations and reports have the task's own rewards.
    pub jerk_cost: f64,
    /// Weight of a penalty on saturation in the actor's loss (not with `ndp`), relative to the
    /// batch's mean |Q|. The penalty is the sum of max(|x| - 2, 0)² over all numbers x of a
    /// decision that get a tanh: the outputs for goal, weights and rho, and the actions before
    /// their tanh. Where a tanh is flat, an actor no longer learns.
    pub saturation_penalty: f64,
    /// Weight of a penalty on the distance from actions that led to the goal, in the actor's loss
    /// (not with `ndp`), relative to the batch's mean |Q|. The penalty is the sum of (u_t - a_t)²
    /// over a decision's noise-free actions and their dimensions, where a_t are the actions of the
    /// sampled window. It is for windows that move the achieved goal and whose episode ends at the
    /// goal, its own or another one of hindsight. It needs hindsight, an environment with a sparse
    /// goal rule, and `critic = "segment"`.
    pub imitation_penalty: f64,
    /// Reward of a step that moves the achieved goal and leaves it in the region of desired goals
    /// and starts, in units of the reward of reaching a goal. It is added while less than half of
    /// the recent episodes move it, if goals are drawn when a batch is sampled and the reward is
    /// sparse. Afterwards it is the reward of a step that ends away in a coordinate of the goals
    /// that is unreached, such as the height (docs/algorithm.md).
    pub motion_bonus: f64,
    /// Whether the critics also see how far from the desired goal a model expects the achieved goal
    /// after each step of the segment. The model learns from the same batches. It needs an
    /// environment with a sparse goal rule and `critic = "segment"`.
    pub outcome_model: bool,
    /// Settings of TD3.
    pub td3: Td3Config,
    /// Settings of SAC, and of TQC's temperature.
    pub sac: SacConfig,
    /// Settings of TQC's critics.
    pub tqc: TqcConfig,
    /// Settings of `ndp`.
    pub ndp: NdpConfig,
}

/// Settings of TD3.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Td3Config {
    /// Standard deviation of the noise on the target policy's actions, in units of u.
    pub target_noise_std: f64,
    /// Target noise is clipped to this absolute value, in units of u.
    pub target_noise_clip: f64,
    /// Weight of the smaller of the two target critics; the larger one has the rest. 1 is TD3, 0.5
    /// the mean. Where targets are clipped to the returns that a sparse reward allows,
    /// overestimation is bounded, and the smaller value alone underestimates.
    pub target_smaller_weight: f64,
    /// Critic updates per update of the actor and the targets.
    pub actor_interval: u64,
}

impl Default for Td3Config {
    fn default() -> Self {
        Self {
            target_noise_std: 0.2,
            target_noise_clip: 0.5,
            target_smaller_weight: 1.0,
            actor_interval: 2,
        }
    }
}

/// Settings of SAC, and of TQC's temperature.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SacConfig {
    /// Initial weight of the entropy.
    pub initial_temperature: f64,
    /// Adam step size of the temperature's logarithm. The default for `mlp` policies is 0.0003, as
    /// published.
    pub temperature_learning_rate: f64,
    /// Target entropy for each action of a decision \[nat\]. The default for `mlp` policies is -1.
    /// Segments need a smaller magnitude because their actions are correlated.
    pub target_entropy_per_action: f64,
}

impl Default for SacConfig {
    fn default() -> Self {
        Self {
            initial_temperature: 1.0,
            temperature_learning_rate: 3e-3,
            target_entropy_per_action: -0.5,
        }
    }
}

/// Settings of TQC's critics.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TqcConfig {
    /// Number of critics.
    pub critics: usize,
    /// Quantiles of the return that each critic predicts.
    pub quantiles: usize,
    /// Largest quantiles that are left out of the target, for each critic.
    pub dropped_quantiles: usize,
}

impl TqcConfig {
    /// Maximum number of critics.
    pub const CRITICS_MAX: usize = 10;
}

impl Default for TqcConfig {
    fn default() -> Self {
        Self { critics: 2, quantiles: 25, dropped_quantiles: 2 }
    }
}

impl AlgorithmConfig {
    /// Returns whether the actor imitates windows that led to their goal. The critics must see
    /// whole segments, because the batch has the actions of a window among their inputs.
    #[must_use]
    pub fn imitates(&self) -> bool {
        self.imitation_penalty > 0.0 && self.critic == CriticInput::Segment
    }
}

impl Default for AlgorithmConfig {
    fn default() -> Self {
        Self {
            name: AlgorithmName::Td3,
            critic: CriticInput::Segment,
            windows: Windows::Sliding,
            target: Target::NStep,
            after_time_limit: AfterTimeLimit::Bootstrap,
            discount: 0.99,
            polyak: 5e-3,
            critic_learning_rate: 1e-3,
            actor_learning_rate: 1e-3,
            // An update takes half as long as with 256, and teaches little less
            // (docs/decisions/0137-batches-of-128.md).
            batch_size: 128,
            critic_hidden: vec![256, 256],
            critic_layer_norm: false,
            action_rate_penalty: 0.2,
            action_acceleration_penalty: 0.0,
            jerk_cost: 0.0,
            saturation_penalty: 0.0,
            imitation_penalty: 0.0,
            motion_bonus: 0.0,
            outcome_model: false,
            td3: Td3Config::default(),
            sac: SacConfig::default(),
            tqc: TqcConfig::default(),
            ndp: NdpConfig::default(),
        }
    }
}

/// How learning rates change over a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LearningRateDecay {
    /// Constant.
    None,
    /// Linear decay to zero at `run.steps`.
    Linear,
}

/// Settings of `ndp`: proximal policy optimisation over segments, as in the released code of Neural
/// Dynamic Policies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct NdpConfig {
    /// Clipping range of the probability ratio. Beyond 1 ± `clip` the ratio no longer improves the
    /// objective.
    pub clip: f64,
    /// Decay of the generalised advantage estimate per segment, in addition to the discount.
    pub gae_lambda: f64,
    /// Segments per rollout, from all workers together and of one policy version; 0 means 10 per
    /// environment.
    pub rollout_segments: usize,
    /// Passes over a rollout.
    pub epochs: usize,
    /// Minibatches per pass. Each has at least one segment and is one step of both optimisers.
    pub minibatches: usize,
    /// Weight of the entropy in the policy's loss.
    pub entropy_coefficient: f64,
    /// Maximum gradient norm of each network; larger gradients are scaled down.
    pub gradient_norm_max: f64,
    /// Logarithm of the initial standard deviation of every action dimension, in units of u.
    pub initial_log_std: f64,
    /// How both learning rates change over the run.
    pub learning_rate_decay: LearningRateDecay,
}

impl Default for NdpConfig {
    fn default() -> Self {
        Self {
            clip: 0.1,
            gae_lambda: 0.95,
            rollout_segments: 0,
            epochs: 10,
            minibatches: 32,
            entropy_coefficient: 0.01,
            gradient_norm_max: 0.5,
            initial_log_std: 0.0,
            learning_rate_decay: LearningRateDecay::Linear,
        }
    }
}

/// Kind of exploration noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ExplorationKind {
    /// Independent Gaussian noise on every action.
    Gaussian,
    /// One Gaussian draw per segment and dimension, held over the segment's steps.
    Segment,
    /// Pink (1/f) noise over the episode.
    Pink,
    /// Gaussian noise on the network's pre-tanh outputs: goal, weights and rho.
    DmpParameters,
}

/// How actions are drawn during the warm-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum WarmUpKind {
    /// Uniform actions within `warm_up_range` of the full range.
    Uniform,
    /// Uniform DMP parameters within `warm_up_range` of their ranges. Unlike with `uniform`, the
    /// DMP's motion y is defined during the warm-up.
    DmpParameters,
    /// One uniform action for each segment, held over its steps.
    Segment,
}

/// Exploration noise of the rollout. `kind` and `std` have no effect on policies that explore by
/// sampling from their own action distribution (SAC, TQC and `ndp`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ExplorationConfig {
    /// Kind of noise.
    pub kind: ExplorationKind,
    /// Standard deviation, in units of u (actions scaled to [-1, 1]).
    pub std: f64,
    /// Share of the segments after the warm-up that ignore the policy: one uniform action over the
    /// full range, held over all steps of the segment. It moves objects that noise around the
    /// policy's actions does not.
    pub random_segments: f64,
    /// Share of `std` and `random_segments` that remains while half of the recent episodes or more
    /// move the achieved goal (as for `algorithm.motion_bonus`). Random actions find an object, and
    /// are in the way of placing it.
    pub settled_share: f64,
    /// Probability, for each decision at which the goal is reached, that a worker's policy gets
    /// another goal to pursue: the desired one of an earlier episode. Environment, replay and
    /// statistics keep the episode's own goal. It needs a sparse goal rule, and `replay.hindsight`,
    /// which gives the replay's windows goals of their own.
    pub goal_switches: f64,
    /// Length of the warm-up, in which actions are random: environment steps of all workers
    /// together.
    pub warm_up_steps: u64,
    /// How actions are drawn during the warm-up.
    pub warm_up_kind: WarmUpKind,
    /// Half-width of the warm-up's uniform distribution, as a fraction of the full range.
    pub warm_up_range: f64,
}

impl Default for ExplorationConfig {
    fn default() -> Self {
        Self {
            kind: ExplorationKind::Gaussian,
            std: 0.1,
            random_segments: 0.0,
            settled_share: 1.0,
            goal_switches: 0.0,
            warm_up_steps: 3_000,
            warm_up_kind: WarmUpKind::Uniform,
            warm_up_range: 0.3,
        }
    }
}
