//! The learning algorithms. Each has its own file, to be read next to its paper.
//!
//! [`Algorithm`] is one of those that learn from a replay: DDPG, TD3 and SAC, with kernels, and
//! those that only `graph` has. NDP ([`ndp`]) learns from rollouts. [`crate::regime`] selects
//! between the two.

pub mod action_penalties;
pub(crate) mod batch;
mod batch_shard;
pub mod cloning;
pub mod ddpg;
pub(crate) mod losses;
mod minibatch_shard;
pub mod ndp;
mod outcome;
mod outcome_shape;
mod ppo;
pub mod sac;
mod sample;
pub mod td3;

use candle_core::{Device, Result};
use dmprl_shared::config::{self, AlgorithmName, ExperimentConfig};
use dmprl_shared::goal_rule::GoalRule;
use dmprl_shared::policy::{MlpShape, Policy, initial_parameters};
use dmprl_shared::seeds;

pub use batch::{Batch, BatchShape, NoWindow};
pub use losses::Losses;

use crate::graph::{self, Graph, NamedNetworks};
use crate::update::network::TrainableNetwork;
use crate::update::thread_pool::ThreadPool;
use ddpg::Ddpg;
pub(crate) use outcome::new_outcome_model;
use sac::Sac;
pub use sample::SampleSource;
use td3::Td3;

/// An algorithm that learns from batches of a replay, with its networks and threads.
#[derive(Debug)]
pub struct Algorithm {
    shape: BatchShape,
    pool: ThreadPool,
    kind: Kind,
    replica: Option<DeviceReplica>,
}

/// A copy of the networks on a device, where updates run as graphs.
#[derive(Debug)]
struct DeviceReplica {
    config: ExperimentConfig,
    device: Device,
    /// `None` if the networks on the host have changed since the graph was made.
    graph: Option<Graph>,
    /// Whether the device has done updates that were not copied back.
    has_unfetched_updates: bool,
}

impl DeviceReplica {
    fn new(config: &ExperimentConfig, device: Device) -> Self {
        Self { config: config.clone(), device, graph: None, has_unfetched_updates: false }
    }
}

#[derive(Debug)]
enum Kind {
    Ddpg(Box<Ddpg>),
    Td3(Box<Td3>),
    Sac(Box<Sac>),
    /// An algorithm without kernels: its networks, the actor first.
    Graph(NamedNetworks),
}

impl Algorithm {
    /// Makes the configured algorithm with newly drawn networks. `rule` is the environment's rule
    /// for goals, if it has one.
    ///
    /// # Errors
    /// If the processor or the device does not support the configuration, or the algorithm does not
    /// learn from a replay.
    pub fn new(
        config: &ExperimentConfig,
        policy: &Policy,
        rule: Option<&GoalRule>,
    ) -> Result<Self> {
        let shape = BatchShape::new(&config.algorithm, policy, rule);
        let kind = match config.algorithm.name {
            AlgorithmName::Ddpg => Kind::Ddpg(Box::new(Ddpg::new(config, policy, shape)?)),
            AlgorithmName::Td3 => Kind::Td3(Box::new(Td3::new(config, policy, shape)?)),
            AlgorithmName::Sac => Kind::Sac(Box::new(Sac::new(config, policy, shape)?)),
            name if name.is_graph_only() => {
                Kind::Graph(graph::new_networks(config, policy, shape)?)
            }
            name => candle_core::bail!("{} does not learn from a replay", name.name()),
        };
        let device = match config.learner.device {
            config::Device::Cpu => Device::Cpu,
            config::Device::Cuda => graph::open_gpu().map_err(|error| {
                error.context("learner.device = \"cuda\": cannot use a GPU (see `dmprl doctor`)")
            })?,
        };
        let replica = config.updates_by_graph().then(|| DeviceReplica::new(config, device));
        Ok(Self { shape, pool: ThreadPool::new(config.learner.threads), kind, replica })
    }

    /// Returns the shape of the batches that [`Algorithm::update`] takes.
    #[must_use]
    pub fn batch_shape(&self) -> BatchShape {
        self.shape
    }

    /// Returns the threads of the updates.
    pub(crate) fn pool(&mut self) -> &mut ThreadPool {
        &mut self.pool
    }

    /// Does update number `update`, counted from 1.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn update(&mut self, policy: &Policy, batch: &Batch, update: u64) -> Result<Losses> {
        if self.replica.is_some() {
            return self.update_on_device(policy, batch, update);
        }
        let pool = &mut self.pool;
        match &mut self.kind {
            Kind::Ddpg(ddpg) => ddpg.update(policy, batch, pool),
            Kind::Td3(td3) => td3.update(policy, batch, pool, update),
            Kind::Sac(sac) => sac.update(policy, batch, pool),
            Kind::Graph(_) => candle_core::bail!("the algorithm has no kernels"),
        }
    }

    fn update_on_device(&mut self, policy: &Policy, batch: &Batch, update: u64) -> Result<Losses> {
        let Self { shape, kind, replica, .. } = self;
        let Some(replica) = replica else { candle_core::bail!("updates run on the host") };
        let graph = match &mut replica.graph {
            Some(graph) => graph,
            None => {
                let DeviceReplica { config, device, .. } = &*replica;
                let graph = Graph::new(config, policy, *shape, device, &kind.networks())?;
                replica.graph.insert(graph)
            }
        };
        replica.has_unfetched_updates = true;
        graph.update(policy, batch, update)
    }

    /// Copies the networks back from the device, if updates run there. Call it before reading
    /// networks.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn fetch(&mut self) -> Result<()> {
        let Some(replica) = &mut self.replica else { return Ok(()) };
        if let Some(graph) = replica.graph.as_ref().filter(|_| replica.has_unfetched_updates) {
            self.kind.for_each_network(|name, network| graph.fetch(name, network))?;
        }
        replica.has_unfetched_updates = false;
        Ok(())
    }

    /// Copies the policy's flat parameters, (P,), from the device that updates them.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn read_policy(&self, values: &mut [f32]) -> Result<()> {
        if let Some(DeviceReplica { graph: Some(graph), has_unfetched_updates: true, .. }) =
            &self.replica
        {
            return graph.read_actor(values);
        }
        values.copy_from_slice(self.kind.actor().parameters.values());
        Ok(())
    }

    /// Sets the actor, and its target if it has one, to the parameters of another policy.
    ///
    /// # Errors
    /// If the lengths differ.
    pub fn set_policy(&mut self, values: &[f32]) -> Result<()> {
        self.discard_graph();
        let actor = self.kind.actor_mut();
        actor.parameters.set(values)?;
        actor.target.as_mut().map_or(Ok(()), |target| target.set(values))
    }

    /// Calls `f` with every network and its name in a checkpoint. `f` may change the network.
    ///
    /// # Errors
    /// The first error that `f` returns.
    pub fn for_each_network<E>(
        &mut self,
        f: impl FnMut(&'static str, &mut TrainableNetwork) -> std::result::Result<(), E>,
    ) -> std::result::Result<(), E> {
        self.discard_graph();
        self.kind.for_each_network(f)
    }

    /// Returns every network with its name in a checkpoint.
    #[must_use]
    pub fn networks(&self) -> Vec<(&'static str, &TrainableNetwork)> {
        self.kind.networks()
    }

    /// Has the device copy the networks again before its next update.
    fn discard_graph(&mut self) {
        if let Some(replica) = &mut self.replica {
            replica.graph = None;
        }
    }
}

impl Kind {
    fn actor(&self) -> &TrainableNetwork {
        match self {
            Self::Ddpg(ddpg) => &ddpg.actor,
            Self::Td3(td3) => &td3.actor,
            Self::Sac(sac) => &sac.actor,
            Self::Graph(networks) => &networks[0].1,
        }
    }

    fn actor_mut(&mut self) -> &mut TrainableNetwork {
        match self {
            Self::Ddpg(ddpg) => &mut ddpg.actor,
            Self::Td3(td3) => &mut td3.actor,
            Self::Sac(sac) => &mut sac.actor,
            Self::Graph(networks) => &mut networks[0].1,
        }
    }

    fn for_each_network<E>(
        &mut self,
        mut f: impl FnMut(&'static str, &mut TrainableNetwork) -> std::result::Result<(), E>,
    ) -> std::result::Result<(), E> {
        let outcome_model = match self {
            Self::Ddpg(ddpg) => {
                f("actor", &mut ddpg.actor)?;
                f("critic", &mut ddpg.critic)?;
                &mut ddpg.outcome_model
            }
            Self::Td3(td3) => {
                f("actor", &mut td3.actor)?;
                f("critic_1", &mut td3.critics[0])?;
                f("critic_2", &mut td3.critics[1])?;
                &mut td3.outcome_model
            }
            Self::Sac(sac) => {
                f("actor", &mut sac.actor)?;
                f("critic_1", &mut sac.critics[0])?;
                f("critic_2", &mut sac.critics[1])?;
                f("log_temperature", &mut sac.log_temperature)?;
                &mut sac.outcome_model
            }
            Self::Graph(networks) => {
                return networks.iter_mut().try_for_each(|(name, network)| f(name, network));
            }
        };
        outcome_model.as_mut().map_or(Ok(()), |model| f("outcome_model", model))
    }

    fn networks(&self) -> Vec<(&'static str, &TrainableNetwork)> {
        let (mut networks, outcome_model) = match self {
            Self::Ddpg(ddpg) => {
                (vec![("actor", &ddpg.actor), ("critic", &ddpg.critic)], &ddpg.outcome_model)
            }
            Self::Td3(td3) => {
                let [first, second] = &td3.critics;
                let networks = [("actor", &td3.actor), ("critic_1", first), ("critic_2", second)];
                (networks.to_vec(), &td3.outcome_model)
            }
            Self::Sac(sac) => {
                let [first, second] = &sac.critics;
                let temperature = ("log_temperature", &sac.log_temperature);
                let networks = [("actor", &sac.actor), ("critic_1", first), ("critic_2", second)];
                ([networks.as_slice(), &[temperature]].concat(), &sac.outcome_model)
            }
            Self::Graph(networks) => {
                return networks.iter().map(|(name, network)| (*name, network)).collect();
            }
        };
        networks.extend(outcome_model.as_ref().map(|model| ("outcome_model", model)));
        networks
    }
}

/// Makes an actor with newly drawn parameters.
pub(crate) fn new_actor(
    config: &ExperimentConfig,
    policy: &Policy,
    target: bool,
) -> Result<TrainableNetwork> {
    let mut random = seeds::stream(config.run.seed, "actor parameters", 0);
    let initial = policy.initial_parameters(&mut random);
    let rate = config.algorithm.actor_learning_rate;
    TrainableNetwork::new(policy.shape().clone(), initial, rate, target, config.learner.precision)
}

/// Makes a critic with its target. Its parameters are drawn from the random stream `name`.
fn new_critic(
    config: &ExperimentConfig,
    shape: BatchShape,
    name: &str,
) -> Result<TrainableNetwork> {
    let mut widths = vec![shape.critic_width()];
    widths.extend(&config.algorithm.critic_hidden);
    widths.push(1);
    let layers = MlpShape::new(widths);
    let initial = initial_parameters(&layers, &mut seeds::stream(config.run.seed, name, 0));
    let rate = config.algorithm.critic_learning_rate;
    let critic = TrainableNetwork::new(layers, initial, rate, true, config.learner.precision)?;
    Ok(if config.algorithm.critic_layer_norm { critic.with_layer_norm() } else { critic })
}

#[cfg(test)]
mod golden_tests;
#[cfg(test)]
mod hindsight_tests;
#[cfg(test)]
mod tests;
