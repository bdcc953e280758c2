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
//!
//! Differences of the preset `default` from the DDPG-DMP paper: segment critic, sliding windows,
//! n-step target, `zero` start, bounded rho, alpha_y 10; `paper` has none of them.

use candle_core::Result;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::{
    Activations, Head, HeadGradient, MlpShape, Policy, PolicyWorkspace, Threads, forward,
    initial_parameters,
};
use dmprl_shared::seeds;

use super::{Batch, BatchShape};
use crate::networks::Parameters;
use crate::update::adam::{Adam, polyak};
use crate::update::backward::{BackwardWorkspace, Pass, input_gradient, parameters_gradient};

/// A network, its slowly following target and its optimiser.
#[derive(Debug)]
pub struct Trained {
    /// The network's parameters.
    pub network: Parameters,
    /// The target's.
    pub target: Parameters,
    /// The optimiser.
    pub adam: Adam,
    gradient: Vec<f32>,
}

impl Trained {
    fn new(initial: Vec<f32>, learning_rate: f64) -> Result<Self> {
        let len = initial.len();
        let network = Parameters::new(initial)?;
        Ok(Self {
            target: network.duplicate()?,
            network,
            adam: Adam::new(len, learning_rate),
            gradient: vec![0.0; len],
        })
    }

    fn step(&mut self) -> Result<()> {
        let Self { network, adam, gradient, .. } = self;
        network.update(|parameters| adam.update(parameters, gradient))
    }

    fn follow(&self, share: f32) -> Result<()> {
        self.network.read(|network| self.target.update(|target| polyak(target, network, share)))?
    }
}

/// Losses of one update.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Losses {
    /// mean (Q - target)^2.
    pub critic_loss: f32,
    /// -mean Q(s, pi(s)).
    pub actor_loss: f32,
    /// mean Q over the batch.
    pub q_mean: f32,
}

/// DDPG: networks, optimisers and the buffers of an update.
#[derive(Debug)]
pub struct Ddpg {
    /// The actor.
    pub actor: Trained,
    /// The critic.
    pub critic: Trained,
    critic_shape: MlpShape,
    shape: BatchShape,
    polyak: f32,
    threads: Threads,
    work: Workspace,
}

#[derive(Debug)]
struct Workspace {
    policy: PolicyWorkspace,
    critic: Activations,
    critic_backward: BackwardWorkspace,
    actor_backward: BackwardWorkspace,
    /// The critic's input with the policy's own actions, (B, critic inputs).
    critic_inputs: Vec<f32>,
    targets: Vec<f32>,
    /// Gradient with respect to actions and end state, (B, actions + end state).
    input_gradient: Vec<f32>,
    /// The same split: (B, K A) and (B, 2A).
    actions_gradient: Vec<f32>,
    end_gradient: Vec<f32>,
}

impl Ddpg {
    /// Freshly drawn networks.
    ///
    /// # Errors
    /// If candle cannot make the variables.
    pub fn new(config: &ExperimentConfig, policy: &Policy) -> Result<Self> {
        let shape = BatchShape::new(&config.algorithm, policy);
        let mut widths = vec![shape.critic_inputs()];
        widths.extend(&config.algorithm.critic_hidden);
        widths.push(1);
        let critic_shape = MlpShape::new(widths);
        let draw = |name| seeds::stream(config.run.seed, name, 0);
        let actor = policy.initial_parameters(&mut draw("actor parameters"));
        let critic = initial_parameters(&critic_shape, &mut draw("critic parameters"));
        let rows = shape.rows;
        Ok(Self {
            actor: Trained::new(actor, config.algorithm.actor_learning_rate)?,
            critic: Trained::new(critic, config.algorithm.critic_learning_rate)?,
            work: Workspace {
                policy: policy.workspace(rows),
                critic: Activations::new(&critic_shape, rows),
                critic_backward: BackwardWorkspace::new(&critic_shape, rows),
                actor_backward: BackwardWorkspace::new(policy.shape(), rows),
                critic_inputs: vec![0.0; rows * shape.critic_inputs()],
                targets: vec![0.0; rows],
                input_gradient: vec![0.0; rows * (shape.actions_len + shape.end_state_len)],
                actions_gradient: vec![0.0; rows * shape.segment_actions_len],
                end_gradient: vec![0.0; rows * shape.end_state_len],
            },
            critic_shape,
            shape,
            polyak: config.algorithm.polyak as f32,
            threads: Threads(config.learner.threads),
        })
    }

    /// The batch that [`Ddpg::update`] takes.
    #[must_use]
    pub fn batch_shape(&self) -> BatchShape {
        self.shape
    }

    /// One update of critic, actor and both targets.
    ///
    /// # Errors
    /// If candle refuses access to a variable.
    pub fn update(&mut self, policy: &Policy, batch: &Batch) -> Result<Losses> {
        self.targets(policy, batch)?;
        let (critic_loss, q_mean) = self.critic_step(batch)?;
        let actor_loss = self.actor_step(policy, batch)?;
        self.critic.follow(self.polyak)?;
        self.actor.follow(self.polyak)?;
        Ok(Losses { critic_loss, actor_loss, q_mean })
    }

    /// target = reward + bootstrap * Q'(s', pi'(s')).
    fn targets(&mut self, policy: &Policy, batch: &Batch) -> Result<()> {
        let (work, threads) = (&mut self.work, self.threads);
        self.actor.target.read(|parameters| {
            policy.act(parameters, &batch.next_observations, &mut work.policy, threads);
        })?;
        self.assemble(policy, &batch.next_observations);
        let (work, shape) = (&mut self.work, &self.critic_shape);
        self.critic.target.read(|parameters| {
            forward(shape, parameters, &work.critic_inputs, &mut work.critic, threads);
        })?;
        let q = work.critic.output(shape, self.shape.rows);
        for (row, target) in work.targets.iter_mut().enumerate() {
            *target = batch.rewards[row] + batch.bootstrap[row] * q[row];
        }
        Ok(())
    }

    /// Descends mean (Q - target)^2; returns the loss and mean Q.
    fn critic_step(&mut self, batch: &Batch) -> Result<(f32, f32)> {
        let (work, shape, threads) = (&mut self.work, &self.critic_shape, self.threads);
        let rows = self.shape.rows;
        let gradient = &mut self.critic.gradient;
        let (loss, q_sum) = self.critic.network.read(|parameters| {
            forward(shape, parameters, &batch.critic_inputs, &mut work.critic, threads);
            let q = work.critic.output(shape, rows);
            let out = work.critic_backward.output_gradient(shape, rows);
            let (mut loss, mut q_sum) = (0.0, 0.0);
            for (row, out) in out.iter_mut().enumerate() {
                let error = q[row] - work.targets[row];
                *out = 2.0 * error / rows as f32;
                loss += error * error;
                q_sum += q[row];
            }
            let pass = Pass {
                shape,
                parameters,
                inputs: &batch.critic_inputs,
                activations: &work.critic,
                threads,
            };
            parameters_gradient(pass, &mut work.critic_backward, gradient);
            (loss, q_sum)
        })?;
        self.critic.step()?;
        Ok((loss / rows as f32, q_sum / rows as f32))
    }

    /// Ascends mean Q(s, pi(s)); returns its negative.
    fn actor_step(&mut self, policy: &Policy, batch: &Batch) -> Result<f32> {
        let threads = self.threads;
        let work = &mut self.work;
        self.actor.network.read(|parameters| {
            policy.act(parameters, &batch.observations, &mut work.policy, threads);
        })?;
        self.assemble(policy, &batch.observations);
        let loss = self.actions_gradient()?;
        let work = &mut self.work;
        let rows = self.shape.rows;
        let outputs = work.actor_backward.output_gradient(policy.shape(), rows);
        match (policy.head(), &mut work.policy.dmp) {
            (Head::Dmp(head), Some(dmp)) => {
                let gradient =
                    HeadGradient { actions: &work.actions_gradient, end_state: &work.end_gradient };
                head.backward(dmp, &work.policy.actions, gradient, outputs);
            }
            _ => {
                let actions = work.policy.actions.iter().zip(&work.actions_gradient);
                for (out, (action, gradient)) in outputs.iter_mut().zip(actions) {
                    *out = gradient * (1.0 - action * action);
                }
            }
        }
        let gradient = &mut self.actor.gradient;
        self.actor.network.read(|parameters| {
            let pass = Pass {
                shape: policy.shape(),
                parameters,
                inputs: &batch.observations,
                activations: &work.policy.activations,
                threads,
            };
            parameters_gradient(pass, &mut work.actor_backward, gradient);
        })?;
        self.actor.step()?;
        Ok(loss)
    }

    /// Gradient of -mean Q with respect to actions and end state; no gradient of the critic's own
    /// parameters, which the actor does not need. Returns -mean Q.
    fn actions_gradient(&mut self) -> Result<f32> {
        let (work, shape, threads) = (&mut self.work, &self.critic_shape, self.threads);
        let rows = self.shape.rows;
        let first = self.shape.observation_len;
        let loss = self.critic.network.read(|parameters| {
            forward(shape, parameters, &work.critic_inputs, &mut work.critic, threads);
            work.critic_backward.output_gradient(shape, rows).fill(-1.0 / rows as f32);
            let pass = Pass {
                shape,
                parameters,
                inputs: &work.critic_inputs,
                activations: &work.critic,
                threads,
            };
            input_gradient(pass, &mut work.critic_backward, first, &mut work.input_gradient);
            -work.critic.output(shape, rows).iter().sum::<f32>() / rows as f32
        })?;
        let BatchShape { actions_len, end_state_len, segment_actions_len, .. } = self.shape;
        let width = actions_len + end_state_len;
        for (row, input) in work.input_gradient.chunks_exact(width).enumerate() {
            // Actions that the critic does not see have no gradient.
            let actions = &mut work.actions_gradient[row * segment_actions_len..];
            actions[..actions_len].copy_from_slice(&input[..actions_len]);
            actions[actions_len..segment_actions_len].fill(0.0);
            let end = &mut work.end_gradient[row * end_state_len..(row + 1) * end_state_len];
            end.copy_from_slice(&input[actions_len..]);
        }
        Ok(loss)
    }

    /// Builds the critic's input from observations and the actions that `work.policy` holds.
    fn assemble(&mut self, policy: &Policy, observations: &[f32]) {
        let work = &mut self.work;
        let BatchShape { observation_len, actions_len, segment_actions_len, .. } = self.shape;
        let width = self.shape.critic_inputs();
        for (row, input) in work.critic_inputs.chunks_exact_mut(width).enumerate() {
            let observation = &observations[row * observation_len..(row + 1) * observation_len];
            let actions = &work.policy.actions[row * segment_actions_len..];
            input[..observation_len].copy_from_slice(observation);
            input[observation_len..observation_len + actions_len]
                .copy_from_slice(&actions[..actions_len]);
        }
        if self.shape.end_state_len > 0
            && let (Head::Dmp(head), Some(dmp)) = (policy.head(), &work.policy.dmp)
        {
            let from = observation_len + actions_len;
            head.end_states(dmp, &mut work.critic_inputs[from..], width);
        }
    }
}

#[cfg(test)]
mod tests;
