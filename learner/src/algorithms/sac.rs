//! Soft actor-critic with a learned temperature (Haarnoja et al. 2018a; 2018b, Algorithm 1) over
//! segments: a squashed Gaussian policy, two critics, and an entropy bonus whose weight keeps the
//! entropy near its target.
//!
//! With policy `dmp` the Gaussian's mean is the inverse controller's value before its tanh at each
//! of the K steps. Its log-std comes from K A more outputs of the network. The entropy is that of
//! the whole segment.
//!
//! Differences from Haarnoja et al. (2018b):
//! 1. An action may be a segment of K actions with one entropy term. The target is the K-step
//!    return (`target = "n_step"`), without entropy for the steps in between. K = 1 is the
//!    published algorithm.
//! 2. The target entropy of segments is -K A / 2. The published -1 per number is too low for
//!    actions that come from one movement.
//! 3. The temperature's loss is linear in its logarithm, as in their code.
//! 4. Squared errors without the factor one half; PyTorch's initialisation.
//! 5. A time limit is not a termination: truncated episodes bootstrap.
//! 6. With policy `dmp` the actor's loss has penalties on changes of its means
//!    (`action_rate_penalty`, `action_acceleration_penalty`). Those on saturation and on the
//!    distance from actions that led to the goal are optional (`saturation_penalty`,
//!    `imitation_penalty`).
//! 7. Learning rates come from the configuration: 1e-3 for networks and 3e-3 for the temperature
//!    instead of 3e-4. Two updates per segment are 0.4 per environment step instead of 1.
//!    Observations are normalised.
//! 8. With `outcome_model` the critics also see predicted outcomes of the segment (`outcome.rs`).

use candle_core::Result;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::{Policy, gaussian};

use super::action_penalties::ActionPenalties;
use super::batch::States;
use super::batch_shard::{BatchShard, LossSums, outcome_step, shards, total};
use super::outcome::new_outcome_model;
use super::{Batch, BatchShape, Losses, new_actor, new_critic};
use crate::update::network::{NetworkView, TrainableNetwork};
use crate::update::thread_pool::ThreadPool;

/// Networks and buffers of SAC.
#[derive(Debug)]
pub struct Sac {
    /// The actor pi, without a target.
    pub actor: TrainableNetwork,
    /// The critics Q_1 and Q_2 with their targets.
    pub critics: [TrainableNetwork; 2],
    /// Logarithm of the temperature, a single number.
    pub log_temperature: TrainableNetwork,
    /// Predicts the outcomes that the critics see, if configured.
    pub outcome_model: Option<TrainableNetwork>,
    target_entropy: f32,
    polyak: f32,
    penalties: ActionPenalties,
    pub(super) shards: Vec<BatchShard>,
}

/// Weights of the terms of the actor's loss.
#[derive(Debug, Clone, Copy)]
struct ActorWeights {
    /// Weight of the entropy.
    temperature: f32,
    /// Weight of the squared changes of the means.
    penalties: ActionPenalties,
}

impl Sac {
    /// Makes newly drawn networks.
    ///
    /// # Errors
    /// If the processor does not support the configured precision.
    pub fn new(config: &ExperimentConfig, policy: &Policy, shape: BatchShape) -> Result<Self> {
        let critics = [
            new_critic(config, shape, "critic parameters")?,
            new_critic(config, shape, "second critic parameters")?,
        ];
        let outcome_model = new_outcome_model(config, shape)?;
        let sac = &config.algorithm.sac;
        let log_temperature = sac.initial_temperature.ln() as f32;
        let rate = sac.temperature_learning_rate;
        Ok(Self {
            actor: new_actor(config, policy, false)?,
            shards: shards(policy, shape, &critics, outcome_model.as_ref()),
            outcome_model,
            critics,
            log_temperature: TrainableNetwork::scalar(log_temperature, rate)?,
            target_entropy: (sac.target_entropy_per_action * shape.segment_actions_len as f64)
                as f32,
            polyak: config.algorithm.polyak as f32,
            penalties: ActionPenalties::new(&config.algorithm),
        })
    }

    /// Updates critics, actor, temperature and targets.
    ///
    /// # Errors
    /// If a network has no target.
    pub fn update(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        pool: &mut ThreadPool,
    ) -> Result<Losses> {
        let rows = batch.rewards.len() as f32;
        let temperature = self.log_temperature.parameters.values()[0].exp();
        outcome_step(&mut self.outcome_model, &mut self.shards, batch, pool);
        self.critics_step(policy, batch, pool, temperature)?;
        let critic = total(&self.shards);
        let penalties = self.penalties.of(critic.q_size / rows);
        self.actor_step(policy, batch, pool, ActorWeights { temperature, penalties });
        let actor = total(&self.shards);
        let entropy = -actor.log_density / rows;
        // The gradient of -log temperature (mean log pi + target entropy).
        self.log_temperature.adam_step_scalar(entropy - self.target_entropy);
        Ok(Losses {
            critic_loss: critic.squared_error / rows,
            actor_loss: Some(actor.actor / rows),
            q_mean: critic.q / rows,
            temperature: Some(temperature),
            entropy: Some(entropy),
        })
    }

    /// Does a step of both critics on the loss mean (Q_i(s, u) - target)², where
    /// target = reward + bootstrap (min_i Q_i'(s', u') - temperature log pi(u'|s')), u' ~ pi(s').
    fn critics_step(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        pool: &mut ThreadPool,
        temperature: f32,
    ) -> Result<()> {
        let [first, second] = &self.critics;
        let actor = self.actor.view();
        let targets = [first.target_view()?, second.target_view()?];
        let critics = [first.view(), second.view()];
        let model = self.outcome_model.as_ref().map(TrainableNetwork::view);
        let model = model.as_ref();
        pool.for_each(&mut self.shards, |shard| {
            draw(shard, policy, &actor, batch.next_states(), &batch.next_noise);
            shard.evaluate_critics(policy, &targets, model, batch.next_states());
            shard.set_targets(batch, |shard, row| {
                let q = shard.q(0)[row].min(shard.q(1)[row]);
                q - temperature * shard.log_densities[row]
            });
            shard.critic_backward(&critics, batch);
        });
        drop((actor, targets, critics));
        for (index, critic) in self.critics.iter_mut().enumerate() {
            critic.adam_step(
                pool,
                &self.shards,
                |shard| shard.critic_record(index, batch),
                Some(self.polyak),
            );
        }
        Ok(())
    }

    /// Does an actor step on the loss mean (temperature log pi(u|s) - min_i Q_i(s, u)), u ~ pi(s),
    /// with the reparametrised gradient of u, plus the penalties on changes of the means.
    fn actor_step(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        pool: &mut ThreadPool,
        weights: ActorWeights,
    ) {
        let ActorWeights { temperature, penalties } = weights;
        let [first, second] = &self.critics;
        let (actor, critics) = (self.actor.view(), [first.view(), second.view()]);
        let model = self.outcome_model.as_ref().map(TrainableNetwork::view);
        let model = model.as_ref();
        pool.for_each(&mut self.shards, |shard| {
            draw(shard, policy, &actor, batch.states(), &batch.noise);
            shard.evaluate_critics(policy, &critics, model, batch.states());
            let smaller =
                |shard: &BatchShard, row: usize| usize::from(shard.q(1)[row] < shard.q(0)[row]);
            shard.sums = LossSums::default();
            for row in 0..shard.log_densities.len() {
                let (q, log_density) =
                    (shard.q(smaller(shard, row))[row], shard.log_densities[row]);
                shard.sums.actor += temperature * log_density - q;
                shard.sums.log_density += log_density;
            }
            let rows = shard.batch_rows();
            shard.actions_gradient(&critics, model, |shard, row, index| {
                if smaller(shard, row) == index { -1.0 / rows } else { 0.0 }
            });
            shard.unsquash();
            // d log pi / d x = 2 u at x = mean + std noise, from the correction for tanh alone.
            let share = temperature / rows;
            for (gradient, u) in shard.actions_gradient.iter_mut().zip(&shard.policy.actions) {
                *gradient += share * 2.0 * u;
            }
            let noise = shard.part(&batch.noise);
            shard.log_stds_backward(policy, |shard, row, index| {
                let at = row * policy.layout().actions_len() + index;
                let drawn = drawn(shard, policy, noise, at);
                // d x / d log std = std noise, and d log pi / d log std = -1 directly.
                let gradient = shard.actions_gradient[at] * drawn.shift - share;
                if drawn.in_range { gradient } else { 0.0 }
            });
            // The penalties are on the means, which act without exploration, whose noise need not
            // be smooth.
            shard.penalise(policy, penalties, batch);
            shard.actor_backward(policy, &actor, penalties);
        });
        drop((actor, critics));
        self.actor.adam_step(pool, &self.shards, |shard| shard.actor_record(batch), None);
    }
}

/// Draws u ~ pi(states) into the shard's actions, and log pi(u) into its log densities.
fn draw(
    shard: &mut BatchShard,
    policy: &Policy,
    actor: &NetworkView<'_>,
    states: States<'_>,
    noise: &[f32],
) {
    shard.act(policy, actor, states);
    let noise = shard.part(noise);
    let len = policy.layout().actions_len();
    for row in 0..shard.log_densities.len() {
        let mut log_density = 0.0;
        for at in row * len..(row + 1) * len {
            let drawn = drawn(shard, policy, noise, at);
            shard.policy.actions[at] = drawn.action;
            log_density += drawn.log_density;
        }
        shard.log_densities[row] = log_density;
    }
}

/// Returns the draw of number `at` of the shard's actions, (rows, K A).
fn drawn(shard: &BatchShard, policy: &Policy, noise: &[f32], at: usize) -> gaussian::Draw {
    let len = policy.layout().actions_len();
    let columns = policy.log_stds().unwrap_or_default();
    let rows = shard.log_densities.len();
    let outputs = shard.policy.activations.output(policy.shape(), rows);
    let raw = outputs[at / len * policy.shape().outputs() + columns.start + at % len];
    gaussian::draw(shard.policy.means[at], raw, noise[at])
}
