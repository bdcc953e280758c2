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
//! 4. A time limit is no termination: truncated episodes bootstrap.
//! 5. Step sizes, polyak, batch and warm-up are the configuration's; `paper` has Table 2's of the
//!    DDPG-DMP paper.
//!
//! Differences of DDPG-DMP with the preset `default` from the paper (`paper` has none of 6 to 11):
//! 6. Critic of the whole segment, sliding windows, n-step target.
//! 7. The DMP starts at zero, has alpha_y 10 and a semi-implicit integrator.
//! 8. Observations are normalised; both step sizes are 1e-3.
//! 9. Two updates a segment; 3 000 warm-up steps within 0.3 of the range; 8 environments a worker.
//! 10. What a task's own defaults say (`shared/src/config/tasks.rs`).
//! 11. The actor pays for changes of its actions (`action_rate_penalty`).
//! 12. rho stays within `rho_range` of (1, 0, 0, 0): our reading of what the paper leaves open,
//!     also in `paper`.

use candle_core::Result;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::Policy;

use super::block::{ActionRate, Block, blocks, total};
use super::{Batch, BatchShape, Losses, new_actor, new_critic};
use crate::update::crew::Crew;
use crate::update::trained::Trained;

/// Networks and buffers of DDPG.
#[derive(Debug)]
pub struct Ddpg {
    /// pi, and its target pi'.
    pub actor: Trained,
    /// Q, and its target Q'.
    pub critic: Trained,
    polyak: f32,
    action_rate_penalty: f32,
    pub(super) blocks: Vec<Block>,
}

impl Ddpg {
    /// Freshly drawn networks.
    ///
    /// # Errors
    /// If candle cannot make the variables.
    pub fn new(config: &ExperimentConfig, policy: &Policy, shape: BatchShape) -> Result<Self> {
        let actor = new_actor(config, policy, true)?;
        let critic = new_critic(config, shape, "critic parameters")?;
        let polyak = config.algorithm.polyak as f32;
        let blocks = blocks(policy, shape, std::slice::from_ref(&critic));
        let action_rate_penalty = config.algorithm.action_rate_penalty as f32;
        Ok(Self { blocks, actor, critic, polyak, action_rate_penalty })
    }

    /// One update of critic, actor and both targets.
    ///
    /// # Errors
    /// If a network lacks its target.
    pub fn update(&mut self, policy: &Policy, batch: &Batch, crew: &Crew) -> Result<Losses> {
        self.critic_step(policy, batch, crew)?;
        let critic = total(&self.blocks);
        let rows = batch.rewards.len() as f32;
        self.actor_step(policy, batch, crew, self.action_rate_penalty * critic.q_size / rows);
        let actor = total(&self.blocks);
        Ok(Losses {
            critic_loss: critic.squared_error / rows,
            actor_loss: Some(actor.actor / rows),
            q_mean: critic.q / rows,
            ..Losses::default()
        })
    }

    /// Descends mean (Q(s, u) - target)², target = reward + bootstrap Q'(s', pi'(s')).
    fn critic_step(&mut self, policy: &Policy, batch: &Batch, crew: &Crew) -> Result<()> {
        let (actor_target, critic_target) = (self.actor.lend_target()?, self.critic.lend_target()?);
        let critic = self.critic.lend();
        let (critic_target, critic) = ([critic_target], [critic]);
        crew.each(&mut self.blocks, |block| {
            block.act(policy, &actor_target, batch.next_states());
            block.judge(policy, &critic_target, batch.next_states());
            block.set_targets(batch, |block, row| block.q(0)[row]);
            block.regress(&critic, batch);
        });
        drop((actor_target, critic_target, critic));
        self.critic.descend(
            crew,
            &self.blocks,
            |block| block.critic_trace(0, batch),
            Some(self.polyak),
        );
        Ok(())
    }

    /// Descends -mean Q(s, pi(s)), and what changes of pi(s) cost.
    fn actor_step(&mut self, policy: &Policy, batch: &Batch, crew: &Crew, penalty: f32) {
        let (actor, critic) = (self.actor.lend(), [self.critic.lend()]);
        crew.each(&mut self.blocks, |block| {
            block.act(policy, &actor, batch.states());
            block.judge(policy, &critic, batch.states());
            block.ascend_q(policy, &actor, &critic, ActionRate { penalty, batch });
        });
        drop((actor, critic));
        self.actor.descend(crew, &self.blocks, |block| block.actor_trace(batch), Some(self.polyak));
    }
}
