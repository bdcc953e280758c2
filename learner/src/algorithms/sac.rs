//! Soft actor-critic with a learned temperature (Haarnoja et al. 2018a; 2018b, Algorithm 1) over
//! segments: a squashed Gaussian policy, two critics, and an entropy bonus whose weight keeps the
//! entropy near its target.
//!
//! With policy `dmp` the Gaussian's mean is the inverse controller's value before its tanh at each
//! of the K steps, and its log-std comes from K A more outputs of the network; the entropy is that
//! of the whole segment.
//!
//! Differences from Haarnoja et al. (2018b):
//! 1. An action may be a segment of K actions with one entropy term; the target is the K-step
//!    return (`target = "n_step"`), whose rewards in between carry no entropy. K = 1 is the
//!    published algorithm.
//! 2. Target entropy -K A / 2 for segments, for whose actions, made by one movement, the published
//!    -1 an action is too little.
//! 3. The temperature's loss is linear in its logarithm, as in their code.
//! 4. Squared errors without the factor one half; PyTorch's initialisation.
//! 5. A time limit is no termination: truncated episodes bootstrap.
//! 6. With policy `dmp` the actor pays for changes of its means (`action_rate_penalty`).
//! 7. Step sizes of networks are the configuration's (1e-3; theirs 3e-4), the temperature's 3e-4;
//!    two updates a segment are 0.4 an environment step (theirs: 1); observations are normalised.

use candle_core::Result;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::{Policy, gaussian};

use super::batch::States;
use super::block::{ActionRate, Block, blocks, total};
use super::{Batch, BatchShape, Losses, new_actor, new_critic};
use crate::update::crew::Crew;
use crate::update::trained::{Lent, Trained};

/// Networks and buffers of SAC.
#[derive(Debug)]
pub struct Sac {
    /// pi; it has no target.
    pub actor: Trained,
    /// Q_1 and Q_2, and their targets.
    pub critics: [Trained; 2],
    /// One number: the temperature's logarithm.
    pub log_temperature: Trained,
    target_entropy: f32,
    polyak: f32,
    action_rate_penalty: f32,
    pub(super) blocks: Vec<Block>,
}

impl Sac {
    /// Freshly drawn networks.
    ///
    /// # Errors
    /// If candle cannot make the variables.
    pub fn new(config: &ExperimentConfig, policy: &Policy, shape: BatchShape) -> Result<Self> {
        let critics = [
            new_critic(config, shape, "critic parameters")?,
            new_critic(config, shape, "second critic parameters")?,
        ];
        let sac = &config.algorithm.sac;
        let log_temperature = sac.initial_temperature.ln() as f32;
        let rate = sac.temperature_learning_rate;
        Ok(Self {
            actor: new_actor(config, policy, false)?,
            blocks: blocks(policy, shape, &critics),
            critics,
            log_temperature: Trained::scalar(log_temperature, rate)?,
            target_entropy: (sac.target_entropy_per_action * shape.segment_actions_len as f64)
                as f32,
            polyak: config.algorithm.polyak as f32,
            action_rate_penalty: config.algorithm.action_rate_penalty as f32,
        })
    }

    /// One update of critics, actor, temperature and targets.
    ///
    /// # Errors
    /// If a network lacks its target.
    pub fn update(&mut self, policy: &Policy, batch: &Batch, crew: &Crew) -> Result<Losses> {
        let rows = batch.rewards.len() as f32;
        let temperature = self.log_temperature.network.values()[0].exp();
        self.critics_step(policy, batch, crew, temperature)?;
        let critic = total(&self.blocks);
        let penalty = self.action_rate_penalty * critic.q_size / rows;
        self.actor_step(policy, batch, crew, (temperature, penalty));
        let actor = total(&self.blocks);
        let entropy = -actor.log_density / rows;
        // Of -log temperature (mean log pi + target entropy).
        self.log_temperature.descend_scalar(entropy - self.target_entropy);
        Ok(Losses {
            critic_loss: critic.squared_error / rows,
            actor_loss: Some(actor.actor / rows),
            q_mean: critic.q / rows,
            temperature: Some(temperature),
            entropy: Some(entropy),
        })
    }

    /// Descends the sum over both critics of mean (Q_i(s, u) - target)²,
    /// target = reward + bootstrap (min_i Q_i'(s', u') - temperature log pi(u'|s')), u' ~ pi(s').
    fn critics_step(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        crew: &Crew,
        temperature: f32,
    ) -> Result<()> {
        let [first, second] = &self.critics;
        let actor = self.actor.lend();
        let targets = [first.lend_target()?, second.lend_target()?];
        let critics = [first.lend(), second.lend()];
        crew.each(&mut self.blocks, |block| {
            draw(block, policy, &actor, batch.next_states(), &batch.next_noise);
            block.judge(policy, &targets, batch.next_states());
            block.set_targets(batch, |block, row| {
                let q = block.q(0)[row].min(block.q(1)[row]);
                q - temperature * block.log_densities[row]
            });
            block.regress(&critics, batch);
        });
        drop((actor, targets, critics));
        for (index, critic) in self.critics.iter_mut().enumerate() {
            critic.descend(
                crew,
                &self.blocks,
                |block| block.critic_trace(index, batch),
                Some(self.polyak),
            );
        }
        Ok(())
    }

    /// Descends mean (temperature log pi(u|s) - min_i Q_i(s, u)), u ~ pi(s), by the path of u, and
    /// what changes of the means' u cost.
    fn actor_step(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        crew: &Crew,
        (temperature, penalty): (f32, f32),
    ) {
        let [first, second] = &self.critics;
        let (actor, critics) = (self.actor.lend(), [first.lend(), second.lend()]);
        crew.each(&mut self.blocks, |block| {
            draw(block, policy, &actor, batch.states(), &batch.noise);
            block.judge(policy, &critics, batch.states());
            let smaller =
                |block: &Block, row: usize| usize::from(block.q(1)[row] < block.q(0)[row]);
            block.sums = super::block::Sums::default();
            for row in 0..block.log_densities.len() {
                let (q, log_density) =
                    (block.q(smaller(block, row))[row], block.log_densities[row]);
                block.sums.actor += temperature * log_density - q;
                block.sums.log_density += log_density;
            }
            let rows = block.batch_rows();
            block.actions_gradient(&critics, |block, row, index| {
                if smaller(block, row) == index { -1.0 / rows } else { 0.0 }
            });
            block.unsquash();
            // d log pi / d x = 2 u at x = mean + std noise: only the tanh's correction moves.
            let share = temperature / rows;
            for (gradient, u) in block.actions_gradient.iter_mut().zip(&block.policy.actions) {
                *gradient += share * 2.0 * u;
            }
            let noise = block.part(&batch.noise);
            block.log_stds_backward(policy, |block, row, index| {
                let at = row * policy.layout().actions_len() + index;
                let drawn = drawn(block, policy, noise, at);
                // log std moves x by std noise, and log pi by -1 directly.
                let gradient = block.actions_gradient[at] * drawn.shift - share;
                if drawn.in_range { gradient } else { 0.0 }
            });
            // Of the means, which act where nothing is drawn: noise is not to be smooth.
            block.penalise(policy, ActionRate { penalty, batch });
            block.act_backward(policy, &actor);
        });
        drop((actor, critics));
        self.actor.descend(crew, &self.blocks, |block| block.actor_trace(batch), None);
    }
}

/// u ~ pi(states) into the block's actions, log pi(u) into its log densities.
fn draw(block: &mut Block, policy: &Policy, actor: &Lent<'_>, states: States<'_>, noise: &[f32]) {
    block.act(policy, actor, states);
    let noise = block.part(noise);
    let len = policy.layout().actions_len();
    for row in 0..block.log_densities.len() {
        let mut log_density = 0.0;
        for at in row * len..(row + 1) * len {
            let drawn = drawn(block, policy, noise, at);
            block.policy.actions[at] = drawn.action;
            log_density += drawn.log_density;
        }
        block.log_densities[row] = log_density;
    }
}

/// What noise makes of action `at` of the block's (rows, K A).
fn drawn(block: &Block, policy: &Policy, noise: &[f32], at: usize) -> gaussian::Draw {
    let len = policy.layout().actions_len();
    let columns = policy.log_stds().unwrap_or_default();
    let rows = block.log_densities.len();
    let outputs = block.policy.activations.output(policy.shape(), rows);
    let raw = outputs[at / len * policy.shape().outputs() + columns.start + at % len];
    gaussian::draw(block.policy.means[at], raw, noise[at])
}
