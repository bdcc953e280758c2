//! The learning algorithms, each in a file to be read beside its paper.

mod batch;
mod block;
pub mod cloning;
pub mod ddpg;
pub mod sac;
pub mod td3;

use candle_core::Result;
use dmprl_shared::config::{AlgorithmName, ExperimentConfig};
use dmprl_shared::policy::{MlpShape, Policy, initial_parameters};
use dmprl_shared::seeds;

pub use batch::{Batch, BatchShape, NoWindow};

use crate::update::crew::Crew;
use crate::update::trained::Trained;
use ddpg::Ddpg;
use sac::Sac;
use td3::Td3;

/// Losses of one update, means over the batch.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Losses {
    /// (Q - target)², the sum of both critics where there are two.
    pub critic_loss: f32,
    /// What the actor descends; none in an update that leaves it as it is.
    pub actor_loss: Option<f32>,
    /// Q of the batch's actions, the first critic's.
    pub q_mean: f32,
    /// Weight of the entropy; SAC's.
    pub temperature: Option<f32>,
    /// -log pi of the actor's draws [nat]; SAC's.
    pub entropy: Option<f32>,
}

/// The algorithm of a run with its networks, on the threads of its update.
#[derive(Debug)]
pub struct Algorithm {
    shape: BatchShape,
    crew: Crew,
    kind: Kind,
}

#[derive(Debug)]
enum Kind {
    Ddpg(Ddpg),
    Td3(Td3),
    Sac(Sac),
}

impl Algorithm {
    /// Freshly drawn networks.
    ///
    /// # Errors
    /// If candle cannot make the variables.
    pub fn new(config: &ExperimentConfig, policy: &Policy) -> Result<Self> {
        let shape = BatchShape::new(&config.algorithm, policy);
        let kind = match config.algorithm.name {
            AlgorithmName::Ddpg => Kind::Ddpg(Ddpg::new(config, policy, shape)?),
            AlgorithmName::Td3 => Kind::Td3(Td3::new(config, policy, shape)?),
            AlgorithmName::Sac => Kind::Sac(Sac::new(config, policy, shape)?),
        };
        Ok(Self { shape, crew: Crew::new(config.learner.threads), kind })
    }

    /// The batch that [`Algorithm::update`] takes.
    #[must_use]
    pub fn batch_shape(&self) -> BatchShape {
        self.shape
    }

    /// Update number `update`, counted from 1.
    ///
    /// # Errors
    /// If candle refuses access to a variable.
    pub fn update(&mut self, policy: &Policy, batch: &Batch, update: u64) -> Result<Losses> {
        match &mut self.kind {
            Kind::Ddpg(ddpg) => ddpg.update(policy, batch, &self.crew),
            Kind::Td3(td3) => td3.update(policy, batch, &self.crew, update),
            Kind::Sac(sac) => sac.update(policy, batch, &self.crew),
        }
    }

    /// The network whose parameters are the policy's.
    #[must_use]
    pub fn actor(&self) -> &Trained {
        match &self.kind {
            Kind::Ddpg(ddpg) => &ddpg.actor,
            Kind::Td3(td3) => &td3.actor,
            Kind::Sac(sac) => &sac.actor,
        }
    }

    /// Hands every network, with the name it has in a checkpoint, to `f`.
    ///
    /// # Errors
    /// The first that `f` returns.
    pub fn each_network<E>(
        &mut self,
        mut f: impl FnMut(&'static str, &mut Trained) -> std::result::Result<(), E>,
    ) -> std::result::Result<(), E> {
        match &mut self.kind {
            Kind::Ddpg(Ddpg { actor, critic, .. }) => {
                f("actor", actor)?;
                f("critic", critic)
            }
            Kind::Td3(Td3 { actor, critics: [first, second], .. }) => {
                f("actor", actor)?;
                f("critic_1", first)?;
                f("critic_2", second)
            }
            Kind::Sac(Sac { actor, critics: [first, second], log_temperature, .. }) => {
                f("actor", actor)?;
                f("critic_1", first)?;
                f("critic_2", second)?;
                f("log_temperature", log_temperature)
            }
        }
    }

    /// As [`Algorithm::each_network`], to read them.
    #[must_use]
    pub fn networks(&self) -> Vec<(&'static str, &Trained)> {
        match &self.kind {
            Kind::Ddpg(ddpg) => vec![("actor", &ddpg.actor), ("critic", &ddpg.critic)],
            Kind::Td3(Td3 { actor, critics: [first, second], .. }) => {
                vec![("actor", actor), ("critic_1", first), ("critic_2", second)]
            }
            Kind::Sac(Sac { actor, critics: [first, second], log_temperature, .. }) => vec![
                ("actor", actor),
                ("critic_1", first),
                ("critic_2", second),
                ("log_temperature", log_temperature),
            ],
        }
    }
}

fn new_actor(config: &ExperimentConfig, policy: &Policy, target: bool) -> Result<Trained> {
    let mut random = seeds::stream(config.run.seed, "actor parameters", 0);
    let initial = policy.initial_parameters(&mut random);
    let rate = config.algorithm.actor_learning_rate;
    Trained::new(policy.shape().clone(), initial, rate, target)
}

/// A critic with its target; its parameters are drawn from the stream `name`.
fn new_critic(config: &ExperimentConfig, shape: BatchShape, name: &str) -> Result<Trained> {
    let mut widths = vec![shape.critic_inputs()];
    widths.extend(&config.algorithm.critic_hidden);
    widths.push(1);
    let layers = MlpShape::new(widths);
    let initial = initial_parameters(&layers, &mut seeds::stream(config.run.seed, name, 0));
    Trained::new(layers, initial, config.algorithm.critic_learning_rate, true)
}

#[cfg(test)]
mod tests;
