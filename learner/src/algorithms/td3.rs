//! Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018, Algorithm 1) over
//! segments: two critics, of whose targets the smaller is used, noise on the target policy's
//! actions, and an actor that is updated every second time.
//!
//! Differences from Fujimoto et al.:
//! 1. With policy `dmp` an action is a segment of K actions, which the critics evaluate as a whole.
//!    Target noise is drawn for each of the K A numbers. A carried DMP state (`start = "carry"`)
//!    enters the target critics without noise. K = 1 is the published algorithm.
//! 2. The target is the K-step return (`target = "n_step"`).
//! 3. Layers have 256 and 256 units instead of 400 and 300; a batch has 256 rows instead of 100.
//! 4. Two updates per segment are 0.4 per environment step instead of 1. Observations are
//!    normalised. Warm-up actions come from a part of the range (`exploration.warm_up_range`).
//! 5. With policy `dmp` the actor's loss has penalties on action changes (`action_rate_penalty`
//!    and `action_acceleration_penalty`). Those on saturation and on the distance from actions that
//!    led to the goal are optional (`saturation_penalty`, `imitation_penalty`).
//! 6. A time limit is not a termination: truncated episodes bootstrap, as in their code.
//! 7. The larger value of the two target critics may have a weight, too (`target_smaller_weight`),
//!    as in Fujimoto et al. 2019, "Off-policy deep reinforcement learning without exploration".
//! 8. With `outcome_model` the critics also see predicted outcomes of the segment (`outcome.rs`).

use candle_core::Result;
use dmprl_shared::config::{ExperimentConfig, Td3Config};
use dmprl_shared::policy::Policy;

use super::action_penalties::ActionPenalties;
use super::batch_shard::{BatchShard, outcome_step, shards, total};
use super::outcome::new_outcome_model;
use super::{Batch, BatchShape, Losses, new_actor, new_critic};
use crate::update::network::TrainableNetwork;
use crate::update::thread_pool::ThreadPool;

/// Networks and buffers of TD3.
#[derive(Debug)]
pub struct Td3 {
    /// The actor pi and its target pi'.
    pub actor: TrainableNetwork,
    /// The critics Q_1 and Q_2 with their targets.
    pub critics: [TrainableNetwork; 2],
    config: Td3Config,
    /// Predicts the outcomes that the critics see, if configured.
    pub outcome_model: Option<TrainableNetwork>,
    polyak: f32,
    penalties: ActionPenalties,
    pub(super) shards: Vec<BatchShard>,
}

impl Td3 {
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
        Ok(Self {
            actor: new_actor(config, policy, true)?,
            shards: shards(policy, shape, &critics, outcome_model.as_ref()),
            outcome_model,
            critics,
            config: config.algorithm.td3.clone(),
            polyak: config.algorithm.polyak as f32,
            penalties: ActionPenalties::new(&config.algorithm),
        })
    }

    /// Does update number `update`, counted from 1. It updates the critics, and every
    /// `actor_interval`-th time also actor and targets.
    ///
    /// # Errors
    /// If a network has no target.
    pub fn update(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        pool: &mut ThreadPool,
        update: u64,
    ) -> Result<Losses> {
        let updates_actor = update.is_multiple_of(self.config.actor_interval);
        outcome_step(&mut self.outcome_model, &mut self.shards, batch, pool);
        self.critics_step(policy, batch, pool, updates_actor.then_some(self.polyak))?;
        let critic = total(&self.shards);
        let rows = batch.rewards.len() as f32;
        let mut losses = Losses {
            critic_loss: critic.squared_error / rows,
            q_mean: critic.q / rows,
            ..Losses::default()
        };
        if updates_actor {
            let penalties = self.penalties.of(critic.q_size / rows);
            self.actor_step(policy, batch, pool, penalties);
            losses.actor_loss = Some(total(&self.shards).actor / rows);
        }
        Ok(losses)
    }

    /// Does a step of both critics on the loss mean (Q_i(s, u) - target)², where
    /// target = reward + bootstrap min_i Q_i'(s', clip(pi'(s') + clipped noise)).
    fn critics_step(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        pool: &mut ThreadPool,
        polyak: Option<f32>,
    ) -> Result<()> {
        let [first, second] = &self.critics;
        let actor_target = self.actor.target_view()?;
        let targets = [first.target_view()?, second.target_view()?];
        let critics = [first.view(), second.view()];
        let (std, clip) =
            (self.config.target_noise_std as f32, self.config.target_noise_clip as f32);
        let weight = self.config.target_smaller_weight as f32;
        let model = self.outcome_model.as_ref().map(TrainableNetwork::view);
        let model = model.as_ref();
        pool.for_each(&mut self.shards, |shard| {
            shard.act(policy, &actor_target, batch.next_states());
            let noise = shard.part(&batch.next_noise);
            for (action, noise) in shard.policy.actions.iter_mut().zip(noise) {
                *action = (*action + (std * noise).clamp(-clip, clip)).clamp(-1.0, 1.0);
            }
            shard.evaluate_critics(policy, &targets, model, batch.next_states());
            shard.set_targets(batch, |shard, row| {
                let (first, second) = (shard.q(0)[row], shard.q(1)[row]);
                weight * first.min(second) + (1.0 - weight) * first.max(second)
            });
            shard.critic_backward(&critics, batch);
        });
        drop((actor_target, targets, critics));
        for (index, critic) in self.critics.iter_mut().enumerate() {
            critic.adam_step(pool, &self.shards, |shard| shard.critic_record(index, batch), polyak);
        }
        Ok(())
    }

    /// Does an actor step on the loss -mean Q_1(s, pi(s)), plus the penalties on action changes.
    fn actor_step(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        pool: &mut ThreadPool,
        penalties: ActionPenalties,
    ) {
        let (actor, critic) = (self.actor.view(), [self.critics[0].view()]);
        let model = self.outcome_model.as_ref().map(TrainableNetwork::view);
        let model = model.as_ref();
        pool.for_each(&mut self.shards, |shard| {
            shard.act(policy, &actor, batch.states());
            shard.evaluate_critics(policy, &critic, model, batch.states());
            shard.deterministic_policy_gradient(policy, &actor, &critic, model, penalties, batch);
        });
        drop((actor, critic));
        self.actor.adam_step(
            pool,
            &self.shards,
            |shard| shard.actor_record(batch),
            Some(self.polyak),
        );
    }
}
