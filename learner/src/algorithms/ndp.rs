//! Neural Dynamic Policies (Bahl et al. 2020): proximal policy optimisation (Schulman et al. 2017,
//! Algorithm 1) of a policy that decides a segment as goal and weights of one DMP per action
//! dimension.
//!
//! One decision is a segment of K environment steps. Its DMP starts where the robot is; the
//! position controller turns the motion into K actions, which are the means of Gaussians with one
//! learned standard deviation per action dimension. The ratio of probabilities is formed for each
//! of the K steps, the value and the advantage for the segment.
//!
//! It uses the same workers as the other algorithms: segments of the newest policy fill a rollout.
//! Segments of older policies, which were in flight, count as environment steps and as stale, and
//! are not learned from. Neither side waits for the other.
//!
//! Differences from Schulman et al.:
//! 1. Advantages and values belong to decisions of K steps: a segment's reward is the discounted
//!    sum of its steps' rewards, the value after it is discounted by discount^steps, and
//!    `gae_lambda` applies per segment.
//! 2. Actor and value are two networks with separate optimisers and gradient norms, so that neither
//!    loss needs a weight. Values are not clipped (as in the paper).
//! 3. A rollout has a number of segments from all environments together, not from each. Episodes
//!    continue across rollouts. A time limit bootstraps from the observation after it.
//! 4. Advantages are scaled to mean 0 and deviation 1 over a rollout, as in most implementations.
//!
//! Differences from Bahl et al. and their released code:
//! 5. All K drawn actions are executed. Their code draws the first action and executes it K times,
//!    but computes ratios with the mean of each step.
//! 6. The critic has one output. Theirs repeats one value K times.
//! 7. y0 and yd0 come from the observations before normalisation. Networks get normalised
//!    observations only with `policy.normalise_observations`. Rewards are not scaled.
//! 8. g = goal_range tanh(.), w = weight_range omega² tanh(.); theirs are 100 times a linear
//!    output.
//! 9. ReLU layers (`policy.hidden`, `algorithm.critic_hidden`) with PyTorch's initialisation
//!    instead of tanh layers of 100 and 300 units with orthogonal initialisation of the last.
//!    Adam's epsilon is 1e-8 instead of 1e-5.
//! 10. Minibatches consist of whole segments, not of single steps.
//! 11. Values are not clipped. The reward is computed at every step; their environments compute it
//!     only at every fifth step (`reward_delay`).
//! 12. If no velocity is observed, yd0 is 0 instead of 0.05. alpha_y and N are the same for all
//!     tasks; theirs are 5 to 15, depending on the task.
//! 13. Actions are `position_scale` times the differences of y, clipped to the environment's
//!     bounds. Theirs are scaled by each environment (0.05) and become joint positions.

use candle_core::Result;
use dmprl_shared::config::{ExperimentConfig, LearningRateDecay, NdpConfig, Precision};
use dmprl_shared::policy::{MlpShape, Policy, initial_parameters};
use dmprl_shared::seeds::{self, Stream};
use dmprl_shared::segment::Segment;
use rand::seq::SliceRandom;

use super::minibatch_shard::{LossSums, MinibatchShard, Objective, RolloutSource};
use super::ppo::entropy;
use crate::normaliser::Normaliser;
use crate::rollout_buffer::{RolloutBuffer, RolloutShape};
use crate::update::SHARD_ROWS;
use crate::update::network::{StepScale, TrainableNetwork};
use crate::update::thread_pool::ThreadPool;

/// Losses of one step of the optimisers, as means over its minibatch.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct NdpLosses {
    /// -min(ratio advantage, clipped ratio advantage).
    pub policy_loss: f32,
    /// (V - return)².
    pub value_loss: f32,
    /// Entropy of the policy in one step \[nat\].
    pub entropy: f32,
    /// Estimated divergence from the policy that acted, (ratio - 1) - log ratio.
    pub approx_kl: f32,
    /// Share of steps whose ratio lies outside 1 - clip .. 1 + clip.
    pub clip_fraction: f32,
}

/// Networks, rollout and buffers.
#[derive(Debug)]
pub struct Ndp {
    /// Maps observations to DMP parameters.
    pub actor: TrainableNetwork,
    /// Logarithms of the standard deviations, (A,), as a network of biases only.
    pub log_std: TrainableNetwork,
    /// Maps observations to V.
    pub critic: TrainableNetwork,
    /// Segments of the current policy.
    pub rollout: RolloutBuffer,
    config: NdpConfig,
    published: Published,
    /// Log densities of the rollout's steps under the policy that acted, (N, K).
    log_densities: Vec<f32>,
    /// The rollout's entries in this epoch's order.
    order: Vec<usize>,
    /// Segments in a minibatch.
    minibatch: usize,
    epoch: usize,
    /// Index in `order` of the next minibatch.
    first: usize,
    /// A copy of the current `log_std`, (A,).
    log_std_values: Vec<f32>,
    shards: Vec<MinibatchShard>,
    pool: ThreadPool,
}

/// The inputs of an update besides the rollout.
#[derive(Debug, Clone, Copy)]
pub struct UpdateContext<'a> {
    /// The policy's architecture.
    pub policy: &'a Policy,
    /// Normalises network inputs, if configured.
    pub normaliser: Option<&'a Normaliser>,
    /// Completed share of the run, 0 to 1.
    pub progress: f64,
}

/// The versions under which the current policy was published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Published {
    /// The policy has changed since it was last published.
    NotYet,
    /// This version and later ones, which have the same parameters.
    Since(u64),
}

impl Ndp {
    /// Makes newly drawn networks and an empty rollout.
    ///
    /// # Errors
    /// If the processor does not support the configured precision.
    pub fn new(config: &ExperimentConfig, policy: &Policy) -> Result<Self> {
        let settings = config.algorithm.ndp.clone();
        let mut random = seeds::stream(config.run.seed, "actor parameters", 0);
        let mut initial = policy.initial_parameters(&mut random);
        let mut initial_log_std = initial.split_off(policy.shape().parameters_len());
        initial_log_std.fill(settings.initial_log_std as f32);
        let dims = initial_log_std.len();
        let rate = config.algorithm.actor_learning_rate;
        let critic_rate = config.algorithm.critic_learning_rate;
        let precision = config.learner.precision;
        let log_std_shape = MlpShape::new(vec![0, dims]);
        let mut widths = vec![policy.layout().observation_len];
        widths.extend(&config.algorithm.critic_hidden);
        widths.push(1);
        let value_shape = MlpShape::new(widths);
        let mut random = seeds::stream(config.run.seed, "critic parameters", 0);
        let value = initial_parameters(&value_shape, &mut random);
        let segments = settings.rollout_segments;
        let minibatch = segments.div_ceil(settings.minibatches);
        let shard_rows = minibatch.min(SHARD_ROWS);
        let shard = |_| MinibatchShard::new(policy, &value_shape, shard_rows);
        Ok(Self {
            shards: (0..minibatch.div_ceil(shard_rows)).map(shard).collect(),
            actor: TrainableNetwork::new(policy.shape().clone(), initial, rate, false, precision)?,
            log_std: TrainableNetwork::new(
                log_std_shape,
                initial_log_std,
                rate,
                false,
                Precision::F32,
            )?,
            critic: TrainableNetwork::new(value_shape, value, critic_rate, false, precision)?,
            rollout: RolloutBuffer::new(RolloutShape {
                layout: policy.layout(),
                segments,
                discount: config.algorithm.discount as f32,
                workers: config.places(),
                envs_per_worker: config.actors.envs_per_worker,
            }),
            config: settings,
            published: Published::NotYet,
            log_densities: vec![0.0; segments * policy.layout().segment_steps],
            order: (0..segments).collect(),
            minibatch,
            epoch: 0,
            first: 0,
            log_std_values: vec![0.0; dims],
            pool: ThreadPool::new(config.learner.threads),
        })
    }

    /// Copies the policy's flat parameters, (P,), into `values`.
    pub fn read_policy(&self, values: &mut [f32]) {
        let (network, log_std) = values.split_at_mut(values.len() - self.log_std_values.len());
        network.copy_from_slice(self.actor.parameters.values());
        log_std.copy_from_slice(self.log_std.parameters.values());
    }

    /// Sets the policy to another policy's flat parameters, (P,).
    ///
    /// # Errors
    /// If the lengths differ.
    pub fn set_policy(&mut self, values: &[f32]) -> Result<()> {
        let (network, log_std) = values.split_at(values.len() - self.log_std_values.len());
        self.actor.parameters.set(network)?;
        self.log_std.parameters.set(log_std)
    }

    /// Calls `f` with every network and its name in a checkpoint. `f` may change the network.
    ///
    /// # Errors
    /// The first error that `f` returns.
    pub fn for_each_network<E>(
        &mut self,
        mut f: impl FnMut(&'static str, &mut TrainableNetwork) -> std::result::Result<(), E>,
    ) -> std::result::Result<(), E> {
        f("actor", &mut self.actor)?;
        f("log_std", &mut self.log_std)?;
        f("critic", &mut self.critic)
    }

    /// Returns every network with its name in a checkpoint.
    #[must_use]
    pub fn networks(&self) -> Vec<(&'static str, &TrainableNetwork)> {
        vec![("actor", &self.actor), ("log_std", &self.log_std), ("critic", &self.critic)]
    }

    /// Takes note of the version under which the current policy was published.
    pub fn policy_published(&mut self, version: u64) {
        if self.published == Published::NotYet {
            self.published = Published::Since(version);
        }
    }

    /// Inserts a segment into the rollout. Returns false if the segment is stale: it comes from an
    /// older policy, or arrived while the previous rollout was learned from.
    pub fn try_insert(&mut self, segment: &Segment) -> bool {
        let Published::Since(version) = self.published else { return false };
        let is_current = segment.header.policy_version >= version && !self.rollout.is_full();
        if is_current {
            self.rollout.insert(&segment.header, &segment.block);
        }
        is_current
    }

    /// Returns whether a complete rollout waits for updates.
    #[must_use]
    pub fn update_due(&self) -> bool {
        self.rollout.is_full()
    }

    /// Returns the number of segments in a minibatch.
    #[must_use]
    pub fn minibatch(&self) -> usize {
        self.minibatch
    }

    /// Learns from one minibatch. After the last one of the last epoch, the rollout is discarded
    /// and the policy must be published. `random` shuffles the segments.
    pub fn update(&mut self, context: UpdateContext<'_>, random: &mut Stream) -> NdpLosses {
        if (self.epoch, self.first) == (0, 0) {
            self.evaluate_rollout(context);
            self.rollout.estimate(self.config.gae_lambda as f32);
        }
        if self.first == 0 {
            self.order.shuffle(random);
        }
        let end = (self.first + self.minibatch).min(self.rollout.len());
        let learning_rate = match self.config.learning_rate_decay {
            LearningRateDecay::None => 1.0,
            LearningRateDecay::Linear => (1.0 - context.progress).max(0.0) as f32,
        };
        let losses = self.minibatch_step(context, self.first..end, learning_rate);
        self.first = end % self.rollout.len();
        if self.first == 0 {
            self.epoch = (self.epoch + 1) % self.config.epochs;
            if self.epoch == 0 {
                self.rollout.clear();
                self.published = Published::NotYet;
            }
        }
        losses
    }

    /// Computes values and log densities of the whole rollout. The parameters are still the
    /// published ones.
    fn evaluate_rollout(&mut self, context: UpdateContext<'_>) {
        let UpdateContext { policy, normaliser, .. } = context;
        self.log_std_values.copy_from_slice(self.log_std.parameters.values());
        let (actor, value) = (self.actor.view(), self.critic.view());
        let layout = policy.layout();
        let (o, k) = (layout.observation_len, layout.segment_steps);
        let Self { rollout, log_densities, shards, .. } = self;
        let shard = &mut shards[0];
        // Sorted, so that each shard gets adjacent entries; earlier epochs have shuffled them.
        self.order.sort_unstable();
        for entries in self.order.chunks(self.minibatch.min(SHARD_ROWS)) {
            let (first, end) = (entries[0], entries[0] + entries.len());
            shard.gather(RolloutSource { rollout, log_densities, normaliser }, entries);
            let out = &mut log_densities[first * k..end * k];
            shard.evaluate_log_densities(policy, &actor, &self.log_std_values, out);
            let before = &rollout.observations[first * o..end * o];
            shard.evaluate_values(&value, normaliser, before, &mut rollout.values[first..end]);
            let after = &rollout.last_observations[first * o..end * o];
            shard.evaluate_values(&value, normaliser, after, &mut rollout.last_values[first..end]);
        }
    }

    /// Does one step of all optimisers on a range of the shuffled entries.
    fn minibatch_step(
        &mut self,
        context: UpdateContext<'_>,
        range: std::ops::Range<usize>,
        learning_rate: f32,
    ) -> NdpLosses {
        let UpdateContext { policy, normaliser, .. } = context;
        self.log_std_values.copy_from_slice(self.log_std.parameters.values());
        let entries = &self.order[range];
        let shard_rows = self.minibatch.min(SHARD_ROWS);
        let shards = &mut self.shards[..entries.len().div_ceil(shard_rows)];
        for (shard, entries) in shards.iter_mut().zip(entries.chunks(shard_rows)) {
            let (rollout, log_densities) = (&self.rollout, &self.log_densities);
            shard.gather(RolloutSource { rollout, log_densities, normaliser }, entries);
        }
        let objective = Objective {
            log_std: &self.log_std_values,
            clip: self.config.clip as f32,
            steps: shards.iter().map(MinibatchShard::steps).sum::<usize>() as f32,
            segments: entries.len() as f32,
        };
        let (actor, value) = (self.actor.view(), self.critic.view());
        let pool = &mut self.pool;
        pool.for_each(shards, |shard| {
            shard.policy_backward(policy, &actor, objective);
            shard.value_backward(&value, objective);
        });
        drop((actor, value));
        self.actor.sum_gradient(pool, shards, MinibatchShard::actor_record);
        self.critic.sum_gradient(pool, shards, MinibatchShard::value_record);
        // The derivative of a Gaussian's entropy with respect to each log std is 1.
        let log_std_gradient = self.log_std.gradient_mut();
        log_std_gradient.fill(-self.config.entropy_coefficient as f32);
        for shard in &*shards {
            for (sum, part) in log_std_gradient.iter_mut().zip(&shard.log_std_gradient) {
                *sum += part;
            }
        }
        let sums = total(shards);
        let losses = NdpLosses {
            policy_loss: sums.policy / objective.steps,
            value_loss: sums.value / objective.segments,
            entropy: entropy(objective.log_std),
            approx_kl: sums.divergence / objective.steps,
            clip_fraction: sums.outside as f32 / objective.steps,
        };
        let policy_norm = (self.actor.gradient_square() + self.log_std.gradient_square()).sqrt();
        let value_norm = self.critic.gradient_square().sqrt();
        let scaled = |norm: f64| StepScale {
            gradient: (self.config.gradient_norm_max / norm).min(1.0) as f32,
            learning_rate,
        };
        self.actor.apply_gradient(scaled(policy_norm));
        self.log_std.apply_gradient(scaled(policy_norm));
        self.critic.apply_gradient(scaled(value_norm));
        losses
    }
}

/// Adds the sums of all shards, in their order.
fn total(shards: &[MinibatchShard]) -> LossSums {
    shards.iter().map(|shard| shard.sums).fold(LossSums::default(), |a, b| LossSums {
        policy: a.policy + b.policy,
        value: a.value + b.value,
        divergence: a.divergence + b.divergence,
        outside: a.outside + b.outside,
    })
}

#[cfg(test)]
mod golden_tests;
#[cfg(test)]
mod tests;
