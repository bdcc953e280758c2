//! Deep deterministic policy gradient (Lillicrap et al. 2016, Algorithm 1) over segments.
//!
//! With policy `dmp` it is DDPG-DMP: the actor's output is a segment's goal, weights and inverse
//! controller, the action of a decision is the whole segment of K actions, and the actor's gradient
//! runs through critic, inverse controller and DMP. With policy `mlp`, K = 1, it is DDPG.
//!
//! Differences from Lillicrap et al.:
//! 1. The critic may see all K actions of a segment (`critic = "segment"`) and its target is then
//!    the K-step return (`target = "n_step"`); K = 1 is the published algorithm.
//! 2. Actions enter the critic at its first layer, not the second; ReLU layers of 256 units
//!    without batch normalisation or weight decay; PyTorch's initialisation in every layer.
//! 3. Exploration noise is Gaussian (uncorrelated by default), not Ornstein-Uhlenbeck.
//! 4. A time limit is not a termination: truncated episodes bootstrap.
//! 5. Learning rates, polyak, batch size and warm-up come from the configuration. The preset
//!    `paper` has those of Table 2 of the DDPG-DMP paper.
//!
//! Differences between DDPG-DMP with the preset `default` and the paper (the preset `paper` has
//! none of 6 to 11):
//! 6. The critic sees the whole segment; windows slide; the target is the n-step return.
//! 7. The DMP starts at zero, has alpha_y 10 and a semi-implicit integrator.
//! 8. Observations are normalised; both learning rates are 1e-3.
//! 9. Two updates per segment; 3 000 warm-up steps within 0.3 of the range; 8 environments per
//!    worker.
//! 10. Tasks have their own defaults (`shared/src/config/tasks.rs`).
//! 11. The actor's loss has penalties on action changes (`action_rate_penalty` and
//!     `action_acceleration_penalty`). Those on saturation and on the distance from actions that
//!     led to the goal are optional (`saturation_penalty`, `imitation_penalty`).
//! 12. rho stays within `rho_range` of (1, 0, 0, 0), because the paper does not specify it. This
//!     also holds for `paper`.
//! 13. With `outcome_model` the critic also sees predicted outcomes of the segment (`outcome.rs`).

use candle_core::Result;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::Policy;

use super::action_penalties::ActionPenalties;
use super::batch_shard::{BatchShard, outcome_step, shards, total};
use super::outcome::new_outcome_model;
use super::{Batch, BatchShape, Losses, new_actor, new_critic};
use crate::update::network::TrainableNetwork;
use crate::update::thread_pool::ThreadPool;

/// Networks and buffers of DDPG.
#[derive(Debug)]
pub struct Ddpg {
    /// The actor pi and its target pi'.
    pub actor: TrainableNetwork,
    /// The critic Q and its target Q'.
    pub critic: TrainableNetwork,
    /// Predicts the outcomes that the critics see, if configured.
    pub outcome_model: Option<TrainableNetwork>,
    polyak: f32,
    penalties: ActionPenalties,
    pub(super) shards: Vec<BatchShard>,
}

impl Ddpg {
    /// Makes newly drawn networks.
    ///
    /// # Errors
    /// If the processor does not support the configured precision.
    pub fn new(config: &ExperimentConfig, policy: &Policy, shape: BatchShape) -> Result<Self> {
        let actor = new_actor(config, policy, true)?;
        let critic = new_critic(config, shape, "critic parameters")?;
        let polyak = config.algorithm.polyak as f32;
        let outcome_model = new_outcome_model(config, shape)?;
        let critics = std::slice::from_ref(&critic);
        let shards = shards(policy, shape, critics, outcome_model.as_ref());
        let penalties = ActionPenalties::new(&config.algorithm);
        Ok(Self { shards, actor, critic, outcome_model, polyak, penalties })
    }

    /// Updates critic, actor and both targets.
    ///
    /// # Errors
    /// If a network has no target.
    pub fn update(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        pool: &mut ThreadPool,
    ) -> Result<Losses> {
        outcome_step(&mut self.outcome_model, &mut self.shards, batch, pool);
        self.critic_step(policy, batch, pool)?;
        let critic = total(&self.shards);
        let rows = batch.rewards.len() as f32;
        self.actor_step(policy, batch, pool, self.penalties.of(critic.q_size / rows));
        let actor = total(&self.shards);
        Ok(Losses {
            critic_loss: critic.squared_error / rows,
            actor_loss: Some(actor.actor / rows),
            q_mean: critic.q / rows,
            ..Losses::default()
        })
    }

    /// Does a critic step on the loss mean (Q(s, u) - target)², where
    /// target = reward + bootstrap Q'(s', pi'(s')).
    fn critic_step(&mut self, policy: &Policy, batch: &Batch, pool: &mut ThreadPool) -> Result<()> {
        let (actor_target, critic_target) = (self.actor.target_view()?, self.critic.target_view()?);
        let critic = self.critic.view();
        let (critic_target, critic) = ([critic_target], [critic]);
        let model = self.outcome_model.as_ref().map(TrainableNetwork::view);
        let model = model.as_ref();
        pool.for_each(&mut self.shards, |shard| {
            shard.act(policy, &actor_target, batch.next_states());
            shard.evaluate_critics(policy, &critic_target, model, batch.next_states());
            shard.set_targets(batch, |shard, row| shard.q(0)[row]);
            shard.critic_backward(&critic, batch);
        });
        drop((actor_target, critic_target, critic));
        self.critic.adam_step(
            pool,
            &self.shards,
            |shard| shard.critic_record(0, batch),
            Some(self.polyak),
        );
        Ok(())
    }

    /// Does an actor step on the loss -mean Q(s, pi(s)), plus the penalties on action changes.
    fn actor_step(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        pool: &mut ThreadPool,
        penalties: ActionPenalties,
    ) {
        let (actor, critic) = (self.actor.view(), [self.critic.view()]);
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
