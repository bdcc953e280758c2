//! Behaviour cloning: the actor imitates demonstrated windows before the first update and, with
//! decreasing weight, beside the updates.
//!
//! loss = mean over windows, steps and dimensions of (pi(s) - u)²
//!
//! With policy `dmp` the gradient runs through inverse controller and movement primitive, so that
//! goal, weights and controller of a segment are fitted together. The least squares of Kim et al.
//! (eqs. 11-12, `dmprl_shared::dmp`) fit the weights of one known trajectory of positions. Here
//! only the actions are known, and one network must fit all observations.

use candle_core::Result;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::Policy;

use super::batch::States;
use super::batch_shard::{BatchShard, shards, total};
use super::{BatchShape, NoWindow, SampleSource};
use crate::parameters::Parameters;
use crate::update::network::TrainableNetwork;
use crate::update::thread_pool::ThreadPool;

/// Maximum draws for one row of a batch. Windows that the end of an episode cut short are drawn
/// again, because they lack actions to imitate.
const TRIES_MAX: usize = 1_000;

/// An actor that imitates demonstrations, with the buffers of its update.
#[derive(Debug)]
pub struct Cloning {
    /// A copy of the actor with its own optimiser.
    pub actor: TrainableNetwork,
    /// The actor's parameters, (P,), which a step changes.
    pub parameters: Vec<f32>,
    shards: Vec<BatchShard>,
    shape: BatchShape,
    /// In the units of environment and DMP, (B, O).
    observations: Vec<f32>,
    /// As network inputs, (B, O).
    inputs: Vec<f32>,
    /// Demonstrated actions, (B, K A).
    actions: Vec<f32>,
}

impl Cloning {
    /// Allocates the buffers for batches of the configured size.
    ///
    /// # Errors
    /// If the processor does not support the configured precision.
    pub fn new(config: &ExperimentConfig, policy: &Policy) -> Result<Self> {
        let shape = BatchShape::new(&config.algorithm, policy, None);
        let (step_size, precision) =
            (config.algorithm.actor_learning_rate, config.learner.precision);
        let parameters = vec![0.0; policy.shape().parameters_len()];
        let layers = policy.shape().clone();
        Ok(Self {
            actor: TrainableNetwork::new(layers, parameters.clone(), step_size, false, precision)?,
            parameters,
            shards: shards(policy, shape, &[], None),
            shape,
            observations: vec![0.0; shape.rows * shape.observation_len],
            inputs: vec![0.0; shape.rows * shape.observation_len],
            actions: vec![0.0; shape.rows * shape.segment_actions_len],
        })
    }

    /// Draws a batch of whole demonstrated windows.
    ///
    /// # Errors
    /// [`NoWindow`] if no whole window is found.
    pub fn sample(&mut self, source: SampleSource<'_>) -> std::result::Result<(), NoWindow> {
        let SampleSource { replay, sampler, normaliser, .. } = source;
        let steps = replay.layout().segment_steps;
        let rows = self.observations.chunks_exact_mut(self.shape.observation_len);
        let rows = rows.zip(self.actions.chunks_exact_mut(self.shape.segment_actions_len));
        for (observation, actions) in rows {
            let whole = (0..TRIES_MAX)
                .map_while(|_| sampler.draw_demonstration(replay))
                .find(|window| window.len() == steps)
                .ok_or(NoWindow { segments: replay.len(), steps })?;
            observation.copy_from_slice(replay.observation(&whole));
            replay.actions(&whole, actions);
        }
        match normaliser {
            Some(normaliser) => normaliser.apply(&self.observations, &mut self.inputs),
            None => self.inputs.copy_from_slice(&self.observations),
        }
        Ok(())
    }

    /// Moves `parameters` by `share` of a step of Adam on the drawn batch. Returns the loss before
    /// the step.
    ///
    /// # Errors
    /// If the lengths of the parameters differ.
    pub fn step(&mut self, policy: &Policy, pool: &mut ThreadPool, share: f32) -> Result<f32> {
        let Self { actor, parameters, shards, observations, inputs, actions, .. } = self;
        actor.parameters.set(parameters)?;
        let states = States { observations, inputs };
        let view = actor.view();
        pool.for_each(shards, |shard| shard.imitation_backward(policy, &view, states, actions));
        drop(view);
        actor.adam_step(pool, shards, |shard| shard.record(inputs), None);
        move_towards(parameters, &actor.parameters, share);
        Ok(total(shards).actor / actions.len() as f32)
    }

    /// Moves `parameters` by `share` of the way to `target`.
    pub fn move_towards(&mut self, target: &Parameters, share: f32) {
        move_towards(&mut self.parameters, target, share);
    }
}

fn move_towards(parameters: &mut [f32], target: &Parameters, share: f32) {
    for (parameter, target) in parameters.iter_mut().zip(target.values()) {
        *parameter += share * (target - *parameter);
    }
}
