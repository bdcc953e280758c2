//! Behaviour cloning: the actor imitates demonstrated windows, before anything else is learned and,
//! with less and less weight, beside it.
//!
//! loss = mean over windows, steps and dimensions of (pi(s) - u)²
//!
//! With policy `dmp` the gradient runs through inverse controller and movement primitive, so that
//! goal, weights and controller of a segment are fitted together. The least squares of Kim et al.
//! (eqs. 11-12, `dmprl_shared::dmp`) fit the weights of a trajectory of positions; here the actions
//! are known, the trajectory is not, and one network must serve all observations.

use candle_core::Result;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::Policy;

use super::batch::States;
use super::block::{Block, blocks, total};
use super::{BatchShape, NoWindow};
use crate::networks::Parameters;
use crate::normaliser::Normaliser;
use crate::replay::{Replay, Sampler};
use crate::update::crew::Crew;
use crate::update::trained::Trained;

/// Draws of demonstrated windows for one row of a batch: those that an episode's end cut short are
/// passed over, as a missing action is none to imitate.
const TRIES_MAX: usize = 1_000;

/// An actor that imitates, with the buffers of its update.
#[derive(Debug)]
pub struct Cloning {
    /// A copy of the actor, with an optimiser of its own.
    pub actor: Trained,
    /// The actor's parameters before and after a step, (P,).
    pub parameters: Vec<f32>,
    blocks: Vec<Block>,
    crew: Crew,
    shape: BatchShape,
    /// (B, O), as they are and as the network sees them.
    observations: Vec<f32>,
    inputs: Vec<f32>,
    /// (B, K A).
    actions: Vec<f32>,
}

impl Cloning {
    /// Buffers for the configuration's batches.
    ///
    /// # Errors
    /// If the network cannot be made.
    pub fn new(config: &ExperimentConfig, policy: &Policy) -> Result<Self> {
        let shape = BatchShape::new(&config.algorithm, policy);
        let (step_size, precision) =
            (config.algorithm.actor_learning_rate, config.learner.precision);
        let parameters = vec![0.0; policy.shape().parameters_len()];
        let layers = policy.shape().clone();
        Ok(Self {
            actor: Trained::new(layers, parameters.clone(), step_size, false, precision)?,
            parameters,
            blocks: blocks(policy, shape, &[]),
            crew: Crew::new(config.learner.threads),
            shape,
            observations: vec![0.0; shape.rows * shape.observation_len],
            inputs: vec![0.0; shape.rows * shape.observation_len],
            actions: vec![0.0; shape.rows * shape.segment_actions_len],
        })
    }

    /// Draws whole demonstrated windows.
    ///
    /// # Errors
    /// [`NoWindow`] if there are hardly any.
    pub fn sample(
        &mut self,
        normaliser: Option<&Normaliser>,
        (replay, sampler): (&Replay, &mut Sampler),
    ) -> std::result::Result<(), NoWindow> {
        let steps = replay.layout().segment_steps;
        let rows = self.observations.chunks_exact_mut(self.shape.observation_len);
        let rows = rows.zip(self.actions.chunks_exact_mut(self.shape.segment_actions_len));
        for (observation, actions) in rows {
            let whole = (0..TRIES_MAX)
                .map_while(|_| sampler.draw_kept(replay))
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

    /// Moves `parameters` by `share` of a step of Adam on what was drawn; returns the loss before.
    ///
    /// # Errors
    /// If candle refuses access to a variable.
    pub fn step(&mut self, policy: &Policy, share: f32) -> Result<f32> {
        let Self { actor, parameters, blocks, crew, observations, inputs, actions, .. } = self;
        actor.network.set(parameters)?;
        let states = States { observations, inputs };
        let lent = actor.lend();
        crew.each(blocks, |block| block.imitate(policy, &lent, states, actions));
        drop(lent);
        actor.descend(crew, blocks, |block| block.trace(inputs), None);
        move_towards(parameters, &actor.network, share);
        Ok(total(blocks).actor / actions.len() as f32)
    }

    /// Moves `parameters` by `share` of the way to those of `network`.
    pub fn follow(&mut self, network: &Parameters, share: f32) {
        move_towards(&mut self.parameters, network, share);
    }
}

fn move_towards(parameters: &mut [f32], network: &Parameters, share: f32) {
    for (parameter, network) in parameters.iter_mut().zip(network.values()) {
        *parameter += share * (network - *parameter);
    }
}
