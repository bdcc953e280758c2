//! Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018, Algorithm 1) over
//! segments: two critics and the smaller of their targets, noise on the target policy's actions,
//! and an actor that moves every second update.
//!
//! Differences from Fujimoto et al.:
//! 1. With policy `dmp` an action is a segment of K actions, judged at once by the critics; target
//!    noise is drawn for each of the K A numbers. A DMP state that is carried on (`start =
//!    "carry"`) enters the target's critics undisturbed. K = 1 is the published algorithm.
//! 2. The target is the K-step return (`target = "n_step"`).
//! 3. Layers of 256 and 256 units for their 400 and 300; a batch of 256 for their 100.
//! 4. Two updates a segment are 0.4 an environment step (theirs: 1); observations are normalised;
//!    warm-up draws are gentler than uniform over the bounds (`exploration.warm_up_range`).
//! 5. With policy `dmp` the actor pays for changes of its actions (`action_rate_penalty`).
//! 6. A time limit is no termination: truncated episodes bootstrap, as in their code.

use candle_core::Result;
use dmprl_shared::config::{ExperimentConfig, Td3Config};
use dmprl_shared::policy::Policy;

use super::block::{ActionRate, Block, blocks, total};
use super::{Batch, BatchShape, Losses, new_actor, new_critic};
use crate::update::crew::Crew;
use crate::update::trained::Trained;

/// Networks and buffers of TD3.
#[derive(Debug)]
pub struct Td3 {
    /// pi, and its target pi'.
    pub actor: Trained,
    /// Q_1 and Q_2, and their targets.
    pub critics: [Trained; 2],
    pub(super) config: Td3Config,
    polyak: f32,
    action_rate_penalty: f32,
    pub(super) blocks: Vec<Block>,
}

impl Td3 {
    /// Freshly drawn networks.
    ///
    /// # Errors
    /// If candle cannot make the variables.
    pub fn new(config: &ExperimentConfig, policy: &Policy, shape: BatchShape) -> Result<Self> {
        let critics = [
            new_critic(config, shape, "critic parameters")?,
            new_critic(config, shape, "second critic parameters")?,
        ];
        Ok(Self {
            actor: new_actor(config, policy, true)?,
            blocks: blocks(policy, shape, &critics),
            critics,
            config: config.algorithm.td3.clone(),
            polyak: config.algorithm.polyak as f32,
            action_rate_penalty: config.algorithm.action_rate_penalty as f32,
        })
    }

    /// Update number `update`, counted from 1, of the critics; every `actor_interval`-th also of
    /// actor and targets.
    ///
    /// # Errors
    /// If a network lacks its target.
    pub fn update(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        crew: &Crew,
        update: u64,
    ) -> Result<Losses> {
        let whole = update.is_multiple_of(self.config.actor_interval);
        self.critics_step(policy, batch, crew, whole.then_some(self.polyak))?;
        let critic = total(&self.blocks);
        let rows = batch.rewards.len() as f32;
        let mut losses = Losses {
            critic_loss: critic.squared_error / rows,
            q_mean: critic.q / rows,
            ..Losses::default()
        };
        if whole {
            let penalty = self.action_rate_penalty * critic.q_size / rows;
            self.actor_step(policy, batch, crew, penalty);
            losses.actor_loss = Some(total(&self.blocks).actor / rows);
        }
        Ok(losses)
    }

    /// Descends the sum over both critics of mean (Q_i(s, u) - target)²,
    /// target = reward + bootstrap min_i Q_i'(s', clip(pi'(s') + clipped noise)).
    fn critics_step(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        crew: &Crew,
        polyak: Option<f32>,
    ) -> Result<()> {
        let [first, second] = &self.critics;
        let actor_target = self.actor.lend_target()?;
        let targets = [first.lend_target()?, second.lend_target()?];
        let critics = [first.lend(), second.lend()];
        let (std, clip) =
            (self.config.target_noise_std as f32, self.config.target_noise_clip as f32);
        crew.each(&mut self.blocks, |block| {
            block.act(policy, &actor_target, batch.next_states());
            let noise = block.part(&batch.next_noise);
            for (action, noise) in block.policy.actions.iter_mut().zip(noise) {
                *action = (*action + (std * noise).clamp(-clip, clip)).clamp(-1.0, 1.0);
            }
            block.judge(policy, &targets, batch.next_states());
            block.set_targets(batch, |block, row| block.q(0)[row].min(block.q(1)[row]));
            block.regress(&critics, batch);
        });
        drop((actor_target, targets, critics));
        for (index, critic) in self.critics.iter_mut().enumerate() {
            critic.descend(crew, &self.blocks, |block| block.critic_trace(index, batch), polyak);
        }
        Ok(())
    }

    /// Descends -mean Q_1(s, pi(s)), and what changes of pi(s) cost.
    fn actor_step(&mut self, policy: &Policy, batch: &Batch, crew: &Crew, penalty: f32) {
        let (actor, critic) = (self.actor.lend(), [self.critics[0].lend()]);
        crew.each(&mut self.blocks, |block| {
            block.act(policy, &actor, batch.states());
            block.judge(policy, &critic, batch.states());
            block.ascend_q(policy, &actor, &critic, ActionRate { penalty, batch });
        });
        drop((actor, critic));
        self.actor.descend(crew, &self.blocks, |block| block.actor_trace(batch), Some(self.polyak));
    }
}
