//! The update as a graph of candle tensors with automatic differentiation. It runs on every device.
//!
//! A [`GraphAlgorithm`] is one file of this folder: its networks, its losses, and its differences
//! from the paper. [`tqc`] exists only here and is the example of the book ("An algorithm of your
//! own"). DDPG, TD3 and SAC also have kernels (`update`), which do the same twice as fast on the
//! CPU. Tests in `algorithms` compare the losses, gradients and parameters of both. Unlike the
//! kernels, candle's operations allocate their outputs.

mod batch;
mod ddpg;
mod losses;
mod modules;
mod network;
mod outcome;
mod policy;
#[cfg(feature = "cuda")]
mod recording;
mod sac;
mod td3;
mod tqc;

use std::fmt::Debug;

use candle_core::{D, DType, Device, Module, Result, Tensor};
use candle_nn::VarBuilder;
use dmprl_shared::config::{AlgorithmConfig, AlgorithmName, ExperimentConfig};
use dmprl_shared::policy::Policy;

use crate::algorithms::batch::{Batch, BatchShape};
use crate::algorithms::losses::Losses;
use crate::update::network::TrainableNetwork;
use batch::{DeviceBatch, Upload};
use losses::{DeviceLosses, FIGURES, Present};
use network::DeviceNetwork;
use policy::{DeviceStates, Means, PolicyGraph, mlp};

/// An algorithm as losses on the graph. All its state is in its networks.
trait GraphAlgorithm: Debug + Send + Sync {
    /// Makes the networks with newly drawn parameters, the actor first. An algorithm with kernels
    /// uses theirs.
    ///
    /// # Errors
    /// If the configuration does not fit.
    fn networks(&self, context: &Context<'_>, _: &Policy) -> Result<NamedNetworks> {
        candle_core::bail!(
            "{} uses the networks of its kernels",
            context.config.algorithm.name.name()
        )
    }

    /// Builds the network `name` with candle-nn on the variables of `builder`. Returns `None` for a
    /// multilayer perceptron as the kernels have it.
    ///
    /// # Errors
    /// If the builder has no such variables.
    fn module(
        &self,
        _: &Context<'_>,
        _: &str,
        _: VarBuilder<'_>,
    ) -> Result<Option<Box<dyn Module>>> {
        Ok(None)
    }

    /// Returns the variant of update number `update`, counted from 1. Updates of the same variant
    /// do the same operations, of which a GPU records one.
    fn variant(&self, _: &ExperimentConfig, _update: u64) -> u64 {
        0
    }

    /// Does an update of `variant`, except for the outcome model. It must not read from the device.
    ///
    /// # Errors
    /// If a device operation fails.
    fn update(&self, graph: &mut Graph, batch: &DeviceBatch, variant: u64) -> Result<DeviceLosses>;
}

/// Networks with their names in a checkpoint.
pub(crate) type NamedNetworks = Vec<(&'static str, TrainableNetwork)>;

/// Configuration and sizes, on which networks depend.
#[derive(Debug, Clone)]
struct Context<'a> {
    config: &'a ExperimentConfig,
    shape: BatchShape,
}

/// Numbers that a step of Adam needs from the host.
const FACTORS: usize = 2;

/// Which of a network's parameters are used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Of {
    /// Its own, with gradients.
    Network,
    /// Its own, without gradients.
    Frozen,
    /// Those of its target network, without gradients, or its own if it has no target.
    Target,
}

/// Result of a critic step.
struct CriticStep {
    losses: DeviceLosses,
    /// Mean of |Q| of the first critic over the batch, a scalar.
    q_size: Tensor,
}

impl CriticStep {
    /// Makes the result from the loss of all critics and Q of the first one, one per row.
    fn new(critic_loss: Tensor, q: Option<Tensor>) -> Result<Self> {
        let Some(q) = q else { candle_core::bail!("there is no critic") };
        let losses = DeviceLosses::of_critics(critic_loss, q.mean_all()?);
        Ok(Self { losses, q_size: q.abs()?.mean_all()? })
    }
}

/// The networks of an algorithm on a device, with its update.
#[derive(Debug)]
pub struct Graph {
    algorithm: &'static dyn GraphAlgorithm,
    config: ExperimentConfig,
    shape: BatchShape,
    device: Device,
    policy: PolicyGraph,
    networks: Vec<DeviceNetwork>,
    /// Batch and factors of the current update.
    upload: Option<Upload>,
    /// Losses of the last update, ([`FIGURES`],).
    figures: Tensor,
    #[cfg(feature = "cuda")]
    recordings: recording::Recordings,
}

/// Opens the first GPU, with one stream for all operations.
///
/// # Errors
/// If there is none, or the program was built without the feature `cuda`.
pub(crate) fn open_gpu() -> Result<Device> {
    // By default candle uses the stream of the thread. It also keeps memory for recordings until
    // the thread ends, and freeing that on the thread's stream crashed.
    let gpu = Device::new_cuda_with_stream(0)?;
    #[cfg(feature = "cuda")]
    // SAFETY: all operations of this device are on this stream, so they are done in order. A
    // recording must not wait for events outside it.
    unsafe {
        gpu.as_cuda_device()?.disable_event_tracking();
    }
    Ok(gpu)
}

/// Returns the algorithm of a name.
fn algorithm(name: AlgorithmName) -> Result<&'static dyn GraphAlgorithm> {
    Ok(match name {
        AlgorithmName::Ddpg => &ddpg::Ddpg,
        AlgorithmName::Td3 => &td3::Td3,
        AlgorithmName::Sac => &sac::Sac,
        AlgorithmName::Tqc => &tqc::Tqc,
        AlgorithmName::Ndp => candle_core::bail!("ndp has no graph"),
    })
}

/// Makes the networks of an algorithm without kernels.
///
/// # Errors
/// If the configuration does not fit.
pub(crate) fn new_networks(
    config: &ExperimentConfig,
    policy: &Policy,
    shape: BatchShape,
) -> Result<NamedNetworks> {
    algorithm(config.algorithm.name)?.networks(&Context { config, shape }, policy)
}

impl Graph {
    /// Copies the networks from the host.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn new(
        config: &ExperimentConfig,
        policy: &Policy,
        shape: BatchShape,
        device: &Device,
        networks: &[(&'static str, &TrainableNetwork)],
    ) -> Result<Self> {
        let algorithm = algorithm(config.algorithm.name)?;
        let context = Context { config, shape };
        let networks = networks.iter().map(|(name, network)| {
            let variables = modules::variables(|builder| algorithm.module(&context, name, builder));
            DeviceNetwork::new(name, network, variables?, device)
        });
        Ok(Self {
            algorithm,
            config: config.clone(),
            shape,
            device: device.clone(),
            policy: PolicyGraph::new(config, policy, device)?,
            networks: networks.collect::<Result<_>>()?,
            upload: None,
            figures: Tensor::zeros(FIGURES, DType::F32, device)?,
            #[cfg(feature = "cuda")]
            recordings: recording::Recordings::default(),
        })
    }

    /// Copies one network, its target and its optimiser back to the host.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn fetch(&self, name: &str, network: &mut TrainableNetwork) -> Result<()> {
        self.network(name)?.fetch(network)
    }

    /// Copies the actor's parameters into `out`.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn read_actor(&self, out: &mut [f32]) -> Result<()> {
        out.copy_from_slice(&self.network("actor")?.parameters.to_vec1::<f32>()?);
        Ok(())
    }

    /// Does update number `update`, counted from 1.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn update(&mut self, policy: &Policy, batch: &Batch, update: u64) -> Result<Losses> {
        self.upload(policy, batch)?;
        let variant = self.algorithm.variant(&self.config, update);
        #[cfg(feature = "cuda")]
        if let Device::Cuda(gpu) = self.device.clone() {
            let present = self.compute_on_gpu(&gpu, variant)?;
            return losses::read(&self.figures, present);
        }
        let present = self.compute(variant)?;
        losses::read(&self.figures, present)
    }

    /// Does an update with the batch on the device. Returns which losses it has written.
    fn compute(&mut self, variant: u64) -> Result<Present> {
        let mut batch = self.batch()?;
        self.outcome_step(&mut batch)?;
        self.algorithm.update(self, &batch, variant)?.write(&self.figures)
    }

    fn network(&self, name: &str) -> Result<&DeviceNetwork> {
        match self.networks.iter().find(|network| network.name == name) {
            Some(network) => Ok(network),
            None => candle_core::bail!("the device has no network {name}"),
        }
    }

    /// Computes the outputs of network `name`, or of its target.
    fn forward(&self, name: &str, of: Of, inputs: &Tensor) -> Result<Tensor> {
        let network = self.network(name)?;
        let tensors = network.tensors(of)?;
        if !network.is_module {
            return mlp(&network.shape, &tensors, inputs);
        }
        let builder = modules::builder(&network.variables, tensors, &self.device);
        let context = Context { config: &self.config, shape: self.shape };
        match self.algorithm.module(&context, name, builder)? {
            Some(module) => module.forward(inputs),
            None => candle_core::bail!("{name} is not built with candle-nn any more"),
        }
    }

    /// Computes the actor's decisions, or those of its target.
    fn means(&self, of: Of, states: &DeviceStates) -> Result<Means> {
        self.policy.means(&self.network("actor")?.tensors(of)?, states)
    }

    /// Returns the critic inputs: states, the actions that the critic sees, and the predicted
    /// outcomes, if configured.
    fn critic_inputs(&self, states: &DeviceStates, actions: &Tensor) -> Result<Tensor> {
        let BatchShape { actions_len, segment_actions_len, .. } = self.shape;
        let seen = match actions_len < segment_actions_len {
            true => actions.narrow(1, 0, actions_len)?,
            false => actions.clone(),
        };
        let inputs = Tensor::cat(&[&states.inputs, &seen], D::Minus1)?;
        match self.predict(Of::Frozen, &inputs, states)? {
            Some(prediction) => Tensor::cat(&[&inputs, &prediction.features], D::Minus1),
            None => Ok(inputs),
        }
    }

    /// Returns the smallest Q of several critics, (B, 1).
    fn smallest_q(&self, critics: &[&str], of: Of, inputs: &Tensor) -> Result<Tensor> {
        let mut q = self.forward(critics[0], of, inputs)?;
        for critic in &critics[1..] {
            q = q.minimum(&self.forward(critic, of, inputs)?)?;
        }
        Ok(q)
    }

    /// Does a step of each critic on mean (Q - target)², with the targets of `next_values`, (B, 1).
    /// With `moves_targets`, it also moves their target networks.
    fn fit_critics(
        &mut self,
        critics: &[&'static str],
        batch: &DeviceBatch,
        next_values: &Tensor,
        moves_targets: bool,
    ) -> Result<CriticStep> {
        let targets = batch.targets(next_values)?;
        let mut sum = self.zero()?;
        let mut first_q = None;
        for critic in critics {
            let q = self.forward(critic, Of::Network, &batch.critic_inputs)?;
            first_q.get_or_insert(q.detach());
            let loss = (q - &targets)?.sqr()?.mean_all()?;
            sum = (sum + loss.detach())?;
            self.descend(critic, &loss, moves_targets)?;
        }
        CriticStep::new(sum, first_q)
    }

    /// Does an actor step on -Q(s, pi(s)) of one critic, plus the penalties, and moves the actor's
    /// target. Returns the loss.
    fn policy_gradient_step(
        &mut self,
        critic: &str,
        batch: &DeviceBatch,
        q_size: &Tensor,
    ) -> Result<Tensor> {
        let means = self.means(Of::Network, &batch.states)?;
        let u = means.means.tanh()?;
        let inputs = self.critic_inputs(&batch.states, &means.with_end_state(&u)?)?;
        let q = self.forward(critic, Of::Frozen, &inputs)?.mean_all()?;
        let loss = (self.penalties(&means, &u, batch, q_size)? - q)?;
        self.descend("actor", &loss, true)?;
        Ok(loss)
    }

    /// Returns the penalties on a policy's decisions: on the rate and the acceleration of its
    /// noise-free actions u, (B, K A), on their distance from actions that led to the goal, and on
    /// saturation. They are sums of squares, as means over the batch and shares of |Q|.
    fn penalties(
        &self,
        means: &Means,
        u: &Tensor,
        batch: &DeviceBatch,
        q_size: &Tensor,
    ) -> Result<Tensor> {
        let algorithm = &self.config.algorithm;
        let mut penalties = self.action_penalties(u, batch, q_size)?;
        if algorithm.saturation_penalty > 0.0 {
            let saturation = means.saturation()?.mul(q_size)?;
            penalties = (penalties + (saturation * algorithm.saturation_penalty)?)?;
        }
        if algorithm.imitates() {
            let imitated = batch.critic_inputs.narrow(1, self.shape.observation_len, u.dim(1)?)?;
            let distance = (u - imitated)?.sqr()?.sum_keepdim(1)?;
            let mean = distance.mul(&batch.led_to_goal)?.mean_all()?.mul(q_size)?;
            penalties = (penalties + (mean * algorithm.imitation_penalty)?)?;
        }
        Ok(penalties)
    }

    /// Returns the penalties on changes of the actions u, (B, K A).
    fn action_penalties(&self, u: &Tensor, batch: &DeviceBatch, q_size: &Tensor) -> Result<Tensor> {
        let dims = self.shape.action_len;
        let changes_of = |x: &Tensor| {
            let len = x.dim(1)? - dims;
            x.narrow(1, dims, len)? - x.narrow(1, 0, len)?
        };
        // 0 for changes that involve an action that does not exist.
        let masked = |changes: &Tensor, masks: &[usize]| {
            let mut parts = Vec::new();
            for (k, column) in masks.iter().enumerate() {
                let has = batch.has_previous.narrow(1, *column, 1)?;
                if k * dims < changes.dim(1)? {
                    parts.push(changes.narrow(1, k * dims, dims)?.broadcast_mul(&has)?);
                }
            }
            let from = parts.len() * dims;
            if from < changes.dim(1)? {
                parts.push(changes.narrow(1, from, changes.dim(1)? - from)?);
            }
            Tensor::cat(&parts, 1)?.sqr()?.sum(1)?.mean_all()?.mul(q_size)
        };
        let changes = changes_of(&Tensor::cat(&[&batch.previous_actions, u], 1)?)?;
        let AlgorithmConfig { action_rate_penalty, action_acceleration_penalty, .. } =
            self.config.algorithm;
        let mut sum = self.zero()?;
        if action_rate_penalty > 0.0 {
            // The first change is before the decision.
            let own = changes.narrow(1, dims, changes.dim(1)? - dims)?;
            sum = (sum + (masked(&own, &[1])? * action_rate_penalty)?)?;
        }
        if action_acceleration_penalty > 0.0 {
            let own = changes_of(&changes)?;
            sum = (sum + (masked(&own, &[0, 1])? * action_acceleration_penalty)?)?;
        }
        Ok(sum)
    }

    /// Returns the scalar 0 on the device.
    fn zero(&self) -> Result<Tensor> {
        Tensor::zeros((), DType::F32, &self.device)
    }

    /// Does one step of Adam of network `name` on `loss`. With `moves_target`, it also moves the
    /// target network, if there is one.
    fn descend(&mut self, name: &str, loss: &Tensor, moves_target: bool) -> Result<()> {
        let gradient = self.network(name)?.gradient_of(loss)?;
        self.step(name, &gradient, moves_target)
    }

    /// Does one step of Adam with a known gradient, (P,).
    fn step(&mut self, name: &str, gradient: &Tensor, moves_target: bool) -> Result<()> {
        let polyak = moves_target.then_some(self.config.algorithm.polyak);
        let Some(index) = self.networks.iter().position(|network| network.name == name) else {
            candle_core::bail!("the device has no network {name}")
        };
        let factors = self.factors(index)?;
        self.networks[index].descend(gradient, &factors, polyak)
    }
}
