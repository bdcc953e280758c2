//! Configuration of the learning algorithm and of exploration.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Which algorithm updates the networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum AlgorithmName {
    /// Deep deterministic policy gradient (Lillicrap et al. 2016), with segments DDPG-DMP.
    Ddpg,
    /// Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018).
    Td3,
    /// Soft actor-critic with a learned temperature (Haarnoja et al. 2018b).
    Sac,
    /// Neural Dynamic Policies (Bahl et al. 2020): proximal policy optimisation, on-policy.
    Ndp,
}

/// Which actions the critic sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CriticInput {
    /// Q(s_t, u_t .. u_{t+K-1}).
    Segment,
    /// Q(s_t, u_t), as the paper; only with `windows = "segment"`.
    First,
}

/// Which K-step windows of the replay are samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Windows {
    /// Any window of K steps inside an episode.
    Sliding,
    /// Only windows that start where a segment started.
    Segment,
}

/// The critic's regression target.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// sum_{k<n} discount^k r_{t+k} + discount^n (1 - terminated) Q'(s_{t+n}, pi'(s_{t+n})).
    NStep,
    /// sum of the K rewards + discount (1 - terminated) Q'(s_{t+1}, pi'(s_{t+1})), as the paper.
    Literal,
}

/// The learning algorithm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AlgorithmConfig {
    /// Which algorithm.
    pub name: AlgorithmName,
    /// Which actions the critic sees.
    pub critic: CriticInput,
    /// Which windows are samples.
    pub windows: Windows,
    /// The critic's regression target.
    pub target: Target,
    /// Discount per environment step.
    pub discount: f64,
    /// Target smoothing: target <- polyak * network + (1 - polyak) * target.
    pub polyak: f64,
    /// Adam step size of the critic.
    pub critic_learning_rate: f64,
    /// Adam step size of the actor.
    pub actor_learning_rate: f64,
    /// Windows in one update.
    pub batch_size: usize,
    /// Widths of the critic's hidden layers.
    pub critic_hidden: Vec<usize>,
    /// Layer normalisation (Ba et al. 2016) of the critic's hidden layers, before their ReLU, in
    /// DDPG, TD3 and SAC: it bounds Q for actions unlike any in the replay (Ball et al. 2023).
    pub critic_layer_norm: bool,
    /// What the actor of DDPG, TD3 or SAC pays, beside Q, for the sum over a decision's actions and
    /// their dimensions of (u_t - u_{t-1})², u being made without noise: as a share of the batch's
    /// mean |Q|, so that it means the same whatever the rewards' scale. What comes before the first
    /// action is the one in the replay. The larger, the smoother.
    pub action_rate_penalty: f64,
    /// What only TD3 has.
    pub td3: Td3Config,
    /// What only SAC has.
    pub sac: SacConfig,
    /// What only `ndp` reads.
    pub ndp: NdpConfig,
}

/// What only TD3 has.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Td3Config {
    /// Standard deviation of the noise on the target policy's actions, in units of u.
    pub target_noise_std: f64,
    /// That noise is clipped to plus and minus this.
    pub target_noise_clip: f64,
    /// Updates of the critics for one of actor and targets.
    pub actor_interval: u64,
}

impl Default for Td3Config {
    fn default() -> Self {
        Self { target_noise_std: 0.2, target_noise_clip: 0.5, actor_interval: 2 }
    }
}

/// What only SAC has.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SacConfig {
    /// Weight of the entropy at the start.
    pub initial_temperature: f64,
    /// Adam step size of the temperature's logarithm.
    pub temperature_learning_rate: f64,
    /// Entropy that the temperature steers to, for each action of a decision \[nat\]. For
    /// `mlp` policies -1 is the default: a segment's actions go together, so it has less.
    pub target_entropy_per_action: f64,
}

impl Default for SacConfig {
    fn default() -> Self {
        Self {
            initial_temperature: 1.0,
            temperature_learning_rate: 3e-4,
            target_entropy_per_action: -0.5,
        }
    }
}

impl Default for AlgorithmConfig {
    fn default() -> Self {
        Self {
            name: AlgorithmName::Td3,
            critic: CriticInput::Segment,
            windows: Windows::Sliding,
            target: Target::NStep,
            discount: 0.99,
            polyak: 5e-3,
            critic_learning_rate: 1e-3,
            actor_learning_rate: 1e-3,
            batch_size: 256,
            critic_hidden: vec![256, 256],
            critic_layer_norm: false,
            action_rate_penalty: 0.2,
            td3: Td3Config::default(),
            sac: SacConfig::default(),
            ndp: NdpConfig::default(),
        }
    }
}

/// How step sizes change over a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LearningRateDecay {
    /// They stay.
    None,
    /// They fall in a straight line to zero at `run.steps`.
    Linear,
}

/// Proximal policy optimisation over segments, after the released code of Neural Dynamic Policies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct NdpConfig {
    /// Half-width of the interval around 1 beyond which a ratio of probabilities earns nothing.
    pub clip: f64,
    /// Weight of the next segment's advantage in this one's, beside the discount.
    pub gae_lambda: f64,
    /// Segments, all workers together, from one policy, learned from at once; 0 stands for 10 of
    /// each environment.
    pub rollout_segments: usize,
    /// Passes over a rollout.
    pub epochs: usize,
    /// Parts of a pass, one step of both optimisers each; a part has at least one segment.
    pub minibatches: usize,
    /// Weight of the entropy in the policy's loss.
    pub entropy_coefficient: f64,
    /// Longest gradient of each network; longer ones are shortened.
    pub gradient_norm_max: f64,
    /// Logarithm of the first standard deviation, in units of u, of every action dimension.
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

/// What exploration adds, and where.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ExplorationKind {
    /// Independent Gaussian noise on every action.
    Gaussian,
    /// One Gaussian draw per segment and dimension, held over its steps.
    Segment,
    /// Pink (1/f) noise over the episode.
    Pink,
    /// Gaussian noise on the network's pre-tanh outputs: goal, weights and rho.
    DmpParameters,
}

/// What the warm-up draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum WarmUpKind {
    /// Uniform actions within `warm_up_range` of the range.
    Uniform,
    /// Uniform DMP parameters within their ranges, so that y is defined.
    DmpParameters,
}

/// How the rollout departs from the policy. A policy that draws from a distribution of its own
/// (SAC) departs by that: `kind` and `std` are then not used.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ExplorationConfig {
    /// What is added.
    pub kind: ExplorationKind,
    /// Standard deviation, in units of u (actions scaled to [-1, 1]).
    pub std: f64,
    /// Environment steps, all workers together, before the policy acts.
    pub warm_up_steps: u64,
    /// What the warm-up draws.
    pub warm_up_kind: WarmUpKind,
    /// Half-width of the warm-up's draw, as a share of the full range.
    pub warm_up_range: f64,
}

impl Default for ExplorationConfig {
    fn default() -> Self {
        Self {
            kind: ExplorationKind::Gaussian,
            std: 0.1,
            warm_up_steps: 3_000,
            warm_up_kind: WarmUpKind::Uniform,
            warm_up_range: 0.3,
        }
    }
}
