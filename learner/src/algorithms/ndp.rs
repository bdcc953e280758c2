//! Neural Dynamic Policies (Bahl et al. 2020): proximal policy optimisation (Schulman et al. 2017,
//! Algorithm 1) of a policy that decides a segment as goal and weights of one DMP per action
//! dimension.
//!
//! One decision is a segment of K environment steps. Its DMP starts where the robot is; the
//! position controller turns the motion into K actions, which are the means of Gaussians with one
//! learned standard deviation per action dimension. The ratio of probabilities is formed for each
//! of the K steps, the value and the advantage for the segment.
//!
//! On-policy through the same workers as the rest: segments of the policy published last fill a
//! rollout; those of older ones, in flight when it came, are counted as environment steps and as
//! stale, and not learned from. Nobody waits for anybody.
//!
//! Differences from Schulman et al.:
//! 1. Advantage and value belong to decisions of K steps: a segment's reward is the discounted sum
//!    of its steps', the value after it counts discount^steps, `gae_lambda` fades per segment.
//! 2. Actor and value are two networks with optimisers and gradient norms of their own, so that
//!    neither loss needs a weight; values are regressed without a clip (as in the paper).
//! 3. A rollout is a number of segments of all environments together, not of each; episodes go on
//!    over its border. A time limit bootstraps from the observation after it.
//! 4. Advantages are scaled to mean 0 and deviation 1 over a rollout, as in most implementations.
//!
//! Differences from Bahl et al. and their released code:
//! 5. All K drawn actions are executed. Their code draws the first and executes it K times, while
//!    its ratios are formed with the mean of each step.
//! 6. The critic has one output. Theirs is named for K, and repeats one value K times.
//! 7. y0 and yd0 are measured, not taken from normalised observations, which the networks see only
//!    with `policy.normalise_observations`. Rewards are not scaled.
//! 8. g = goal_range tanh(.), w = weight_range omega² tanh(.); theirs are 100 times a linear
//!    output.
//! 9. ReLU layers (`policy.hidden`, `algorithm.critic_hidden`) with PyTorch's initialisation for
//!    their tanh layers of 100 and 300, of which the last is orthogonal. Adam's epsilon 1e-8, not
//!    1e-5.
//! 10. Minibatches are made of whole segments, not of single steps.
//! 11. Values are regressed without their clip. A reward is every step's; their environments
//!     compute it anew at every fifth step only (`reward_delay`).
//! 12. Where no velocity is observed yd0 is 0, theirs 0.05; alpha_y and N are the same for all
//!     tasks, theirs 5 to 15 by task.
//! 13. Actions are `position_scale` times the differences of y and clipped to the environment's
//!     bounds; theirs are scaled by each environment (0.05) and become joint positions.

use candle_core::Result;
use dmprl_shared::config::{ExperimentConfig, LearningRateDecay, NdpConfig, Precision};
use dmprl_shared::policy::{MlpShape, Policy, initial_parameters};
use dmprl_shared::seeds::{self, Stream};
use dmprl_shared::segment::Segment;
use rand::seq::SliceRandom;

use super::minibatch::{Block, Objective, Source, Sums};
use super::ppo::entropy;
use crate::normaliser::Normaliser;
use crate::rollout_buffer::{RolloutBuffer, RolloutShape};
use crate::update::BLOCK_ROWS;
use crate::update::crew::Crew;
use crate::update::trained::{Scaling, Trained};

/// Losses of one step of the optimisers, means over its minibatch.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct NdpLosses {
    /// -min(ratio advantage, clipped ratio advantage).
    pub policy_loss: f32,
    /// (V - return)².
    pub value_loss: f32,
    /// Of the policy in one step \[nat\].
    pub entropy: f32,
    /// Divergence from the policy that acted, (ratio - 1) - log ratio.
    pub approx_kl: f32,
    /// Share of steps whose ratio lies outside 1 - clip .. 1 + clip.
    pub clip_fraction: f32,
}

/// Networks, rollout and buffers.
#[derive(Debug)]
pub struct Ndp {
    /// From observation to DMP parameters.
    pub actor: Trained,
    /// Logarithms of the standard deviations, (A,): a network of biases alone.
    pub log_std: Trained,
    /// From observation to V.
    pub critic: Trained,
    /// The segments of the policy that acts.
    pub rollout: RolloutBuffer,
    config: NdpConfig,
    published: Published,
    /// Of every step of the rollout under the policy that acted, (N, K).
    log_densities: Vec<f32>,
    /// The rollout's entries in this epoch's order.
    order: Vec<usize>,
    /// Segments in a minibatch.
    minibatch: usize,
    epoch: usize,
    /// Where in `order` the next minibatch begins.
    first: usize,
    /// The present `log_std`, copied.
    log_std_values: Vec<f32>,
    blocks: Vec<Block>,
}

/// What an update happens in.
#[derive(Debug, Clone, Copy)]
pub struct Scene<'a> {
    /// The policy's architecture.
    pub policy: &'a Policy,
    /// Threads.
    pub crew: &'a Crew,
    /// What networks see observations through.
    pub normaliser: Option<&'a Normaliser>,
    /// Share of the run that is over, 0 to 1.
    pub progress: f64,
}

/// Which segments are the present policy's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Published {
    /// The policy has changed and is not published: no segment is.
    NotYet,
    /// Those of this version and later ones, which differ in number only.
    Since(u64),
}

impl Ndp {
    /// Freshly drawn networks and an empty rollout.
    ///
    /// # Errors
    /// If candle cannot make the variables.
    pub fn new(config: &ExperimentConfig, policy: &Policy) -> Result<Self> {
        let settings = config.algorithm.ndp.clone();
        let mut random = seeds::stream(config.run.seed, "actor parameters", 0);
        let mut initial = policy.initial_parameters(&mut random);
        let initial_log_std = initial.split_off(policy.shape().parameters_len());
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
        let block_rows = minibatch.min(BLOCK_ROWS);
        let block = |_| Block::new(policy, &value_shape, block_rows);
        Ok(Self {
            blocks: (0..minibatch.div_ceil(block_rows)).map(block).collect(),
            actor: Trained::new(policy.shape().clone(), initial, rate, false, precision)?,
            log_std: Trained::new(log_std_shape, initial_log_std, rate, false, Precision::F32)?,
            critic: Trained::new(value_shape, value, critic_rate, false, precision)?,
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
        })
    }

    /// Copies the policy's flat parameters out.
    pub fn read_policy(&self, values: &mut [f32]) {
        let (network, log_std) = values.split_at_mut(values.len() - self.log_std_values.len());
        network.copy_from_slice(self.actor.network.values());
        log_std.copy_from_slice(self.log_std.network.values());
    }

    /// Starts from another policy's flat parameters.
    ///
    /// # Errors
    /// If the lengths differ.
    pub fn set_policy(&mut self, values: &[f32]) -> Result<()> {
        let (network, log_std) = values.split_at(values.len() - self.log_std_values.len());
        self.actor.network.set(network)?;
        self.log_std.network.set(log_std)
    }

    /// Hears that the policy as it is has been published.
    pub fn published(&mut self, version: u64) {
        if self.published == Published::NotYet {
            self.published = Published::Since(version);
        }
    }

    /// Takes a segment into the rollout; false, and nothing else, if it is stale: another policy's,
    /// or one that came while the rollout before was learned from.
    pub fn take(&mut self, segment: &Segment) -> bool {
        let Published::Since(version) = self.published else { return false };
        let own = segment.header.policy_version >= version && !self.rollout.is_full();
        if own {
            self.rollout.insert(&segment.header, &segment.block);
        }
        own
    }

    /// Whether a rollout is complete and not yet learned from to the end.
    #[must_use]
    pub fn update_due(&self) -> bool {
        self.rollout.is_full()
    }

    /// Segments in a minibatch.
    #[must_use]
    pub fn minibatch(&self) -> usize {
        self.minibatch
    }

    /// One minibatch. After the last of the last epoch the rollout is forgotten, and the policy is
    /// to be published. `random` shuffles the segments.
    pub fn update(&mut self, scene: Scene<'_>, random: &mut Stream) -> NdpLosses {
        if (self.epoch, self.first) == (0, 0) {
            self.judge(scene);
            self.rollout.estimate(self.config.gae_lambda as f32);
        }
        if self.first == 0 {
            self.order.shuffle(random);
        }
        let end = (self.first + self.minibatch).min(self.rollout.len());
        let share = match self.config.learning_rate_decay {
            LearningRateDecay::None => 1.0,
            LearningRateDecay::Linear => (1.0 - scene.progress).max(0.0) as f32,
        };
        let losses = self.descend(scene, self.first..end, share);
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

    /// Values and log densities of the whole rollout: from the parameters that were published, as
    /// they have not changed since.
    fn judge(&mut self, scene: Scene<'_>) {
        let Scene { policy, normaliser, .. } = scene;
        self.log_std_values.copy_from_slice(self.log_std.network.values());
        let (actor, value) = (self.actor.lend(), self.critic.lend());
        let layout = policy.layout();
        let (o, k) = (layout.observation_len, layout.segment_steps);
        let Self { rollout, log_densities, blocks, .. } = self;
        let block = &mut blocks[0];
        // Entries that stand together, whatever the epochs before left.
        self.order.sort_unstable();
        for entries in self.order.chunks(self.minibatch.min(BLOCK_ROWS)) {
            let (first, end) = (entries[0], entries[0] + entries.len());
            block.gather(Source { rollout, log_densities, normaliser }, entries);
            let out = &mut log_densities[first * k..end * k];
            block.judge(policy, &actor, &self.log_std_values, out);
            let seen = &rollout.observations[first * o..end * o];
            block.appraise(&value, normaliser, seen, &mut rollout.values[first..end]);
            let last = &rollout.last_observations[first * o..end * o];
            block.appraise(&value, normaliser, last, &mut rollout.last_values[first..end]);
        }
    }

    /// One step of all optimisers on the entries at `places` of the order.
    fn descend(
        &mut self,
        scene: Scene<'_>,
        places: std::ops::Range<usize>,
        share: f32,
    ) -> NdpLosses {
        let Scene { policy, crew, normaliser, .. } = scene;
        self.log_std_values.copy_from_slice(self.log_std.network.values());
        let entries = &self.order[places];
        let block_rows = self.minibatch.min(BLOCK_ROWS);
        let blocks = &mut self.blocks[..entries.len().div_ceil(block_rows)];
        for (block, entries) in blocks.iter_mut().zip(entries.chunks(block_rows)) {
            let (rollout, log_densities) = (&self.rollout, &self.log_densities);
            block.gather(Source { rollout, log_densities, normaliser }, entries);
        }
        let objective = Objective {
            log_std: &self.log_std_values,
            clip: self.config.clip as f32,
            steps: blocks.iter().map(Block::steps).sum::<usize>() as f32,
            segments: entries.len() as f32,
        };
        let (actor, value) = (self.actor.lend(), self.critic.lend());
        crew.each(blocks, |block| {
            block.improve(policy, &actor, objective);
            block.regress(&value, objective);
        });
        drop((actor, value));
        self.actor.sum_gradient(crew, blocks, Block::actor_trace);
        self.critic.sum_gradient(crew, blocks, Block::value_trace);
        // The entropy of a Gaussian grows with each log std at slope 1.
        let of_log_std = self.log_std.gradient_mut();
        of_log_std.fill(-self.config.entropy_coefficient as f32);
        for block in &*blocks {
            for (sum, part) in of_log_std.iter_mut().zip(&block.log_std_gradient) {
                *sum += part;
            }
        }
        let sums = total(blocks);
        let losses = NdpLosses {
            policy_loss: sums.policy / objective.steps,
            value_loss: sums.value / objective.segments,
            entropy: entropy(objective.log_std),
            approx_kl: sums.divergence / objective.steps,
            clip_fraction: sums.outside as f32 / objective.steps,
        };
        let policy_norm = (self.actor.gradient_square() + self.log_std.gradient_square()).sqrt();
        let value_norm = self.critic.gradient_square().sqrt();
        let scaling = |norm: f64| Scaling {
            factor: (self.config.gradient_norm_max / norm).min(1.0) as f32,
            share,
        };
        self.actor.step(scaling(policy_norm));
        self.log_std.step(scaling(policy_norm));
        self.critic.step(scaling(value_norm));
        losses
    }
}

/// The sums of all blocks, in their order.
fn total(blocks: &[Block]) -> Sums {
    blocks.iter().map(|block| block.sums).fold(Sums::default(), |a, b| Sums {
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
