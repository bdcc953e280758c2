//! The learning algorithms, each in a file to be read beside its paper.

mod batch;
mod block;
pub mod cloning;
pub mod ddpg;
mod minibatch;
pub mod ndp;
mod optimiser_steps;
mod ppo;
mod products;
pub mod sac;
pub mod td3;

use candle_core::{Device, Result};
use dmprl_shared::config::{self, AlgorithmName, ExperimentConfig};
use dmprl_shared::policy::{MlpShape, Policy, initial_parameters};
use dmprl_shared::seeds;

pub use batch::{Batch, BatchShape, NoWindow};
pub use optimiser_steps::OptimiserSteps;
pub use products::Cycle;

use crate::graph::Graph;
use crate::update::crew::Crew;
use crate::update::trained::Trained;
use ddpg::Ddpg;
use ndp::Ndp;
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
    /// -log pi of the actor's draws \[nat\]; SAC's.
    pub entropy: Option<f32>,
}

/// The algorithm of a run with its networks, on the threads of its update.
#[derive(Debug)]
pub struct Algorithm {
    shape: BatchShape,
    crew: Crew,
    kind: Kind,
    remote: Option<Remote>,
}

/// The same on another device, and which side is behind.
#[derive(Debug)]
struct Remote {
    config: ExperimentConfig,
    device: Device,
    /// None: the networks here have changed since it was made.
    graph: Option<Graph>,
    /// Whether the device has done updates that the networks here have not seen.
    is_ahead: bool,
}

impl Remote {
    fn new(config: &ExperimentConfig, device: Device) -> Self {
        Self { config: config.clone(), device, graph: None, is_ahead: false }
    }
}

#[derive(Debug)]
enum Kind {
    Ddpg(Box<Ddpg>),
    Td3(Box<Td3>),
    Sac(Box<Sac>),
    Ndp(Box<Ndp>),
}

impl Algorithm {
    /// Freshly drawn networks.
    ///
    /// # Errors
    /// If candle cannot make the variables.
    pub fn new(config: &ExperimentConfig, policy: &Policy) -> Result<Self> {
        let shape = BatchShape::new(&config.algorithm, policy);
        let kind = match config.algorithm.name {
            AlgorithmName::Ddpg => Kind::Ddpg(Box::new(Ddpg::new(config, policy, shape)?)),
            AlgorithmName::Td3 => Kind::Td3(Box::new(Td3::new(config, policy, shape)?)),
            AlgorithmName::Sac => Kind::Sac(Box::new(Sac::new(config, policy, shape)?)),
            AlgorithmName::Ndp => Kind::Ndp(Box::new(Ndp::new(config, policy)?)),
        };
        let remote = match config.learner.device {
            config::Device::Cpu => None,
            config::Device::Cuda => Some(Remote::new(config, Device::new_cuda(0)?)),
        };
        Ok(Self { shape, crew: Crew::new(config.learner.threads), kind, remote })
    }

    /// The batch that [`Algorithm::update`] takes.
    #[must_use]
    pub fn batch_shape(&self) -> BatchShape {
        self.shape
    }

    /// The on-policy algorithm and the threads of its update, if it is one: it keeps its own
    /// experience.
    pub fn on_policy(&mut self) -> Option<(&mut Ndp, &Crew)> {
        match &mut self.kind {
            Kind::Ndp(ndp) => Some((ndp, &self.crew)),
            _ => None,
        }
    }

    /// As [`Algorithm::on_policy`], to look at it.
    #[must_use]
    pub fn as_on_policy(&self) -> Option<&Ndp> {
        match &self.kind {
            Kind::Ndp(ndp) => Some(ndp),
            _ => None,
        }
    }

    /// Update number `update`, counted from 1, of an algorithm that learns from the replay.
    ///
    /// # Errors
    /// If candle refuses access to a variable, or the algorithm is on-policy.
    pub fn update(&mut self, policy: &Policy, batch: &Batch, update: u64) -> Result<Losses> {
        if let Some(losses) = self.update_remote(policy, batch, update)? {
            return Ok(losses);
        }
        match &mut self.kind {
            Kind::Ddpg(ddpg) => ddpg.update(policy, batch, &self.crew),
            Kind::Td3(td3) => td3.update(policy, batch, &self.crew, update),
            Kind::Sac(sac) => sac.update(policy, batch, &self.crew),
            Kind::Ndp(_) => candle_core::bail!("an on-policy algorithm samples no batch"),
        }
    }

    /// The update on another device; none if there is no other.
    fn update_remote(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        update: u64,
    ) -> Result<Option<Losses>> {
        let Some(mut remote) = self.remote.take() else { return Ok(None) };
        let losses = self.update_on(&mut remote, policy, batch, update);
        self.remote = Some(remote);
        losses.map(Some)
    }

    fn update_on(
        &self,
        remote: &mut Remote,
        policy: &Policy,
        batch: &Batch,
        update: u64,
    ) -> Result<Losses> {
        let graph = match &mut remote.graph {
            Some(graph) => graph,
            None => {
                let networks = self.networks();
                let Remote { config, device, .. } = &*remote;
                let graph = Graph::new(config, policy, self.shape, device, &networks)?;
                remote.graph.insert(graph)
            }
        };
        remote.is_ahead = true;
        graph.update(policy, batch, update)
    }

    /// Brings back what another device has learned since: to be called before networks are read.
    ///
    /// # Errors
    /// If the device refuses.
    pub fn fetch(&mut self) -> Result<()> {
        let Some(mut remote) = self.remote.take() else { return Ok(()) };
        let fetched = match &remote.graph {
            Some(graph) if remote.is_ahead => {
                self.each_network(|name, trained| graph.fetch(name, trained))
            }
            _ => Ok(()),
        };
        remote.is_ahead &= fetched.is_err();
        self.remote = Some(remote);
        fetched
    }

    /// Copies the policy's flat parameters, (P,), out, from wherever they are newest.
    ///
    /// # Errors
    /// If candle or the device refuses.
    pub fn read_policy(&self, values: &mut [f32]) -> Result<()> {
        if let Some(Remote { graph: Some(graph), is_ahead: true, .. }) = &self.remote {
            return graph.read_actor(values);
        }
        match &self.kind {
            Kind::Ddpg(ddpg) => values.copy_from_slice(ddpg.actor.network.values()),
            Kind::Td3(td3) => values.copy_from_slice(td3.actor.network.values()),
            Kind::Sac(sac) => values.copy_from_slice(sac.actor.network.values()),
            Kind::Ndp(ndp) => ndp.read_policy(values),
        }
        Ok(())
    }

    /// Starts the actor, and its target if it has one, from another policy's parameters.
    ///
    /// # Errors
    /// If the lengths differ.
    pub fn set_policy(&mut self, values: &[f32]) -> Result<()> {
        if let Some(remote) = &mut self.remote {
            remote.graph = None;
        }
        match &mut self.kind {
            Kind::Ddpg(ddpg) => set(&mut ddpg.actor, values),
            Kind::Td3(td3) => set(&mut td3.actor, values),
            Kind::Sac(sac) => set(&mut sac.actor, values),
            Kind::Ndp(ndp) => ndp.set_policy(values),
        }
    }

    /// Hands every network, with the name it has in a checkpoint, to `f`, which may change it.
    ///
    /// # Errors
    /// The first that `f` returns.
    pub fn each_network<E>(
        &mut self,
        mut f: impl FnMut(&'static str, &mut Trained) -> std::result::Result<(), E>,
    ) -> std::result::Result<(), E> {
        if let Some(remote) = &mut self.remote {
            remote.graph = None;
        }
        match &mut self.kind {
            Kind::Ddpg(ddpg) => {
                f("actor", &mut ddpg.actor)?;
                f("critic", &mut ddpg.critic)
            }
            Kind::Td3(td3) => {
                f("actor", &mut td3.actor)?;
                f("critic_1", &mut td3.critics[0])?;
                f("critic_2", &mut td3.critics[1])
            }
            Kind::Sac(sac) => {
                f("actor", &mut sac.actor)?;
                f("critic_1", &mut sac.critics[0])?;
                f("critic_2", &mut sac.critics[1])?;
                f("log_temperature", &mut sac.log_temperature)
            }
            Kind::Ndp(ndp) => {
                f("actor", &mut ndp.actor)?;
                f("log_std", &mut ndp.log_std)?;
                f("critic", &mut ndp.critic)
            }
        }
    }

    /// As [`Algorithm::each_network`], to read them.
    #[must_use]
    pub fn networks(&self) -> Vec<(&'static str, &Trained)> {
        match &self.kind {
            Kind::Ddpg(ddpg) => vec![("actor", &ddpg.actor), ("critic", &ddpg.critic)],
            Kind::Td3(td3) => {
                let [first, second] = &td3.critics;
                vec![("actor", &td3.actor), ("critic_1", first), ("critic_2", second)]
            }
            Kind::Sac(sac) => {
                let [first, second] = &sac.critics;
                let temperature = ("log_temperature", &sac.log_temperature);
                vec![("actor", &sac.actor), ("critic_1", first), ("critic_2", second), temperature]
            }
            Kind::Ndp(ndp) => {
                vec![("actor", &ndp.actor), ("log_std", &ndp.log_std), ("critic", &ndp.critic)]
            }
        }
    }
}

fn set(actor: &mut Trained, values: &[f32]) -> Result<()> {
    actor.network.set(values)?;
    actor.target.as_mut().map_or(Ok(()), |target| target.set(values))
}

fn new_actor(config: &ExperimentConfig, policy: &Policy, target: bool) -> Result<Trained> {
    let mut random = seeds::stream(config.run.seed, "actor parameters", 0);
    let initial = policy.initial_parameters(&mut random);
    let rate = config.algorithm.actor_learning_rate;
    Trained::new(policy.shape().clone(), initial, rate, target, config.learner.precision)
}

/// A critic with its target; its parameters are drawn from the stream `name`.
fn new_critic(config: &ExperimentConfig, shape: BatchShape, name: &str) -> Result<Trained> {
    let mut widths = vec![shape.critic_inputs()];
    widths.extend(&config.algorithm.critic_hidden);
    widths.push(1);
    let layers = MlpShape::new(widths);
    let initial = initial_parameters(&layers, &mut seeds::stream(config.run.seed, name, 0));
    let rate = config.algorithm.critic_learning_rate;
    let critic = Trained::new(layers, initial, rate, true, config.learner.precision)?;
    Ok(if config.algorithm.critic_layer_norm { critic.with_layer_norm() } else { critic })
}

#[cfg(test)]
mod golden_tests;
#[cfg(test)]
mod tests;
