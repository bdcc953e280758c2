//! The update as a graph of candle tensors with automatic differentiation. It runs on a GPU.
//!
//! On the CPU, the kernels of `update` do the same several times faster. Tests in `algorithms`
//! compare the losses, gradients and parameters of both. Unlike the kernels, candle's operations
//! allocate their outputs.

mod outcome;
mod policy;

use candle_core::{D, Device, Result, Tensor, Var};
use dmprl_shared::config::{AlgorithmName, ExperimentConfig};
use dmprl_shared::policy::{Head, MlpShape, Policy};

use crate::algorithms::batch::{Batch, BatchShape};
use crate::algorithms::losses::Losses;
use crate::update::kernels::{BETA1, BETA2, EPSILON};
use crate::update::layer_norm::LayerNorm;
use crate::update::network::TrainableNetwork;
use outcome::Prediction;
use policy::{DeviceStates, PolicyGraph, mlp};

/// A network with its target and optimiser on the device.
#[derive(Debug)]
struct DeviceNetwork {
    name: &'static str,
    shape: MlpShape,
    layer_norm: Option<LayerNorm>,
    parameters: Var,
    target: Option<Var>,
    moments: [Tensor; 2],
    step: u64,
    learning_rate: f64,
    /// Gradient of the last step.
    gradient: Option<Tensor>,
}

/// Losses of a critic step, as means over the batch.
struct CriticLosses {
    /// (Q - target)², summed over the critics.
    critic_loss: f32,
    /// Q of the first critic.
    q_mean: f32,
    /// |Q| of the first critic.
    q_size: f64,
}

/// The networks of an algorithm on a device, with its update.
#[derive(Debug)]
pub struct Graph {
    config: ExperimentConfig,
    shape: BatchShape,
    device: Device,
    policy: PolicyGraph,
    networks: Vec<DeviceNetwork>,
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
        let networks =
            networks.iter().map(|(name, network)| DeviceNetwork::new(name, network, device));
        Ok(Self {
            config: config.clone(),
            shape,
            device: device.clone(),
            policy: PolicyGraph::new(config, policy, device)?,
            networks: networks.collect::<Result<_>>()?,
        })
    }

    /// Copies one network, its target and its optimiser back to the host.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn fetch(&self, name: &str, network: &mut TrainableNetwork) -> Result<()> {
        let ours = self.device_network(name)?;
        network.parameters.set(&ours.parameters.to_vec1::<f32>()?)?;
        if let (Some(own), Some(target)) = (&mut network.target, &ours.target) {
            own.set(&target.to_vec1::<f32>()?)?;
        }
        network.adam.moments.first = ours.moments[0].to_vec1()?;
        network.adam.moments.second = ours.moments[1].to_vec1()?;
        network.adam.step.0 = ours.step;
        if let Some(gradient) = &ours.gradient {
            network.set_gradient(&gradient.to_vec1::<f32>()?);
        }
        Ok(())
    }

    /// Copies the actor's parameters into `out`.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn read_actor(&self, out: &mut [f32]) -> Result<()> {
        out.copy_from_slice(&self.device_network("actor")?.parameters.to_vec1::<f32>()?);
        Ok(())
    }

    fn device_network(&self, name: &str) -> Result<&DeviceNetwork> {
        match self.networks.iter().find(|network| network.name == name) {
            Some(network) => Ok(network),
            None => candle_core::bail!("the device has no network {name}"),
        }
    }

    fn q(&self, name: &str, of_target: bool, inputs: &Tensor) -> Result<Tensor> {
        let network = self.device_network(name)?;
        let layer_norm = network.layer_norm.as_ref();
        match (&network.target, of_target) {
            (Some(target), true) => {
                mlp(&network.shape, layer_norm, &target.as_detached_tensor(), inputs)
            }
            _ => mlp(&network.shape, layer_norm, &network.parameters, inputs),
        }
    }

    /// Returns the names of the algorithm's critics, the first one first.
    fn critics(&self) -> &'static [&'static str] {
        match self.config.algorithm.name {
            AlgorithmName::Ddpg => &["critic"],
            _ => &["critic_1", "critic_2"],
        }
    }

    /// Does update number `update`, counted from 1, like the algorithm of the same name.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn update(&mut self, policy: &Policy, batch: &Batch, update: u64) -> Result<Losses> {
        let td3 = &self.config.algorithm.td3;
        let updates_actor = self.config.algorithm.name != AlgorithmName::Td3
            || update.is_multiple_of(td3.actor_interval);
        let states = self.states(policy, &batch.observations, &batch.inputs)?;
        let prediction = self.outcome_step(&states, batch)?;
        let temperature = self.temperature()?;
        let CriticLosses { critic_loss, q_mean, q_size } =
            self.critics_step(policy, batch, &prediction, &temperature, updates_actor)?;
        let mut losses = Losses { critic_loss, q_mean, ..Losses::default() };
        if updates_actor {
            let penalty = self.config.algorithm.action_rate_penalty * q_size;
            let (loss, entropy) = self.actor_step(&states, batch, &temperature, penalty)?;
            losses.actor_loss = Some(loss);
            losses.entropy = entropy;
            losses.temperature = temperature
                .map(|value| value.to_vec1())
                .transpose()?
                .map(|value: Vec<f32>| value[0]);
            if let Some(entropy) = entropy {
                let per_action = self.config.algorithm.sac.target_entropy_per_action;
                let wanted = (per_action * self.shape.segment_actions_len as f64) as f32;
                let gradient = Tensor::new(&[entropy - wanted], &self.device)?;
                self.step("log_temperature", gradient, false)?;
            }
        }
        Ok(losses)
    }

    fn temperature(&self) -> Result<Option<Tensor>> {
        match self.config.algorithm.name {
            AlgorithmName::Sac => Ok(Some(
                self.device_network("log_temperature")?.parameters.as_detached_tensor().exp()?,
            )),
            _ => Ok(None),
        }
    }

    fn on_device(&self, values: &[f32]) -> Result<Tensor> {
        Tensor::from_slice(values, (self.shape.rows, values.len() / self.shape.rows), &self.device)
    }

    fn states(
        &self,
        policy: &Policy,
        observations: &[f32],
        inputs: &[f32],
    ) -> Result<DeviceStates> {
        let starts = match policy.head() {
            Head::Dmp(head) => head.starts(observations),
            Head::Mlp => Vec::new(),
        };
        let rows = starts.len() / 2;
        Ok(DeviceStates {
            inputs: self.on_device(inputs)?,
            starts: Tensor::from_vec(starts, (rows, 2), &self.device)?,
            goal_distances: self.goal_distances(observations)?,
        })
    }

    /// Returns the critic inputs: states and the actions that the critic sees.
    fn critic_inputs(&self, states: &DeviceStates, actions: &Tensor) -> Result<Tensor> {
        let BatchShape { actions_len, segment_actions_len, .. } = self.shape;
        let seen = match actions_len < segment_actions_len {
            true => actions.narrow(1, 0, actions_len)?,
            false => actions.clone(),
        };
        let inputs = Tensor::cat(&[&states.inputs, &seen], D::Minus1)?;
        match self.predict(&inputs, states)? {
            Some(prediction) => Tensor::cat(&[&inputs, &prediction.features], D::Minus1),
            None => Ok(inputs),
        }
    }

    /// Returns the smallest Q of the algorithm's critics.
    fn smallest_q(&self, of_target: bool, inputs: &Tensor) -> Result<Tensor> {
        let critics = self.critics();
        let mut q = self.q(critics[0], of_target, inputs)?;
        for critic in &critics[1..] {
            q = q.minimum(&self.q(critic, of_target, inputs)?)?;
        }
        Ok(q)
    }

    /// Returns the value of the target critics.
    fn target_q(&self, inputs: &Tensor) -> Result<Tensor> {
        let algorithm = &self.config.algorithm;
        if algorithm.name != AlgorithmName::Td3 {
            return self.smallest_q(true, inputs);
        }
        let [first, second] = ["critic_1", "critic_2"].map(|critic| self.q(critic, true, inputs));
        let (first, second) = (first?, second?);
        let weight = algorithm.td3.target_smaller_weight;
        (first.minimum(&second)? * weight)? + (first.maximum(&second)? * (1.0 - weight))?
    }

    fn targets(
        &self,
        policy: &Policy,
        batch: &Batch,
        temperature: &Option<Tensor>,
    ) -> Result<Tensor> {
        let states = self.states(policy, &batch.next_observations, &batch.next_inputs)?;
        let actor = self.device_network("actor")?;
        let parameters = actor.target.as_ref().unwrap_or(&actor.parameters).as_detached_tensor();
        let means = self.policy.means(&parameters, &states)?;
        let mut bonus = None;
        let u = match temperature {
            Some(temperature) => {
                let (u, density) = means.draw(&self.on_device(&batch.next_noise)?)?;
                bonus = Some(density.broadcast_mul(temperature)?);
                u
            }
            None if self.shape.next_noise => {
                let td3 = &self.config.algorithm.td3;
                let noise = (self.on_device(&batch.next_noise)? * td3.target_noise_std)?;
                let noise = noise.clamp(-td3.target_noise_clip, td3.target_noise_clip)?;
                (means.means.tanh()? + noise)?.clamp(-1.0, 1.0)?
            }
            None => means.means.tanh()?,
        };
        let inputs = self.critic_inputs(&states, &means.with_end_state(&u)?)?;
        let mut value = self.target_q(&inputs)?;
        if let Some(bonus) = bonus {
            value = (value - bonus)?;
        }
        let (rewards, bootstrap) =
            (self.on_device(&batch.rewards)?, self.on_device(&batch.bootstrap)?);
        let [low, high] = batch.target_range;
        let targets = (rewards + bootstrap.mul(&value)?)?;
        Ok(targets.clamp(low, high)?.detach())
    }

    fn critics_step(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        prediction: &Option<Prediction>,
        temperature: &Option<Tensor>,
        target_step: bool,
    ) -> Result<CriticLosses> {
        let targets = self.targets(policy, batch, temperature)?;
        let mut inputs = self.on_device(&batch.critic_inputs)?;
        if let Some(prediction) = prediction {
            inputs = Tensor::cat(&[&inputs, &prediction.features.detach()], D::Minus1)?;
        }
        let (mut sum, mut q_mean, mut q_size) = (0.0, 0.0, 0.0);
        for (index, critic) in self.critics().iter().enumerate() {
            let q = self.q(critic, false, &inputs)?;
            if index == 0 {
                q_mean = q.mean_all()?.to_scalar()?;
                q_size = f64::from(q.abs()?.mean_all()?.to_scalar::<f32>()?);
            }
            let loss = (q - &targets)?.sqr()?.mean_all()?;
            sum += loss.to_scalar::<f32>()?;
            self.descend(critic, &loss, target_step)?;
        }
        Ok(CriticLosses { critic_loss: sum, q_mean, q_size })
    }

    fn actor_step(
        &mut self,
        states: &DeviceStates,
        batch: &Batch,
        temperature: &Option<Tensor>,
        penalty: f64,
    ) -> Result<(f32, Option<f32>)> {
        let means = self.policy.means(&self.device_network("actor")?.parameters, states)?;
        let cost = |u: &Tensor| self.squared_changes(u, batch)? * penalty;
        let (loss, entropy) = match temperature {
            Some(temperature) => {
                let (u, density) = means.draw(&self.on_device(&batch.noise)?)?;
                let inputs = self.critic_inputs(states, &means.with_end_state(&u)?)?;
                let entropy = -density.mean_all()?.to_scalar::<f32>()?;
                let q = self.smallest_q(false, &inputs)?;
                let loss = (density.broadcast_mul(temperature)? - q)?.mean_all()?;
                ((loss + cost(&means.means.tanh()?)?)?, Some(entropy))
            }
            None => {
                let u = means.means.tanh()?;
                let inputs = self.critic_inputs(states, &means.with_end_state(&u)?)?;
                let loss = self.q(self.critics()[0], false, &inputs)?.mean_all()?.neg()?;
                ((loss + cost(&u)?)?, None)
            }
        };
        self.descend("actor", &loss, true)?;
        Ok((loss.to_scalar()?, entropy))
    }

    /// Returns the sum of the squared changes of u, (B, K A), as a mean over the batch.
    fn squared_changes(&self, u: &Tensor, batch: &Batch) -> Result<Tensor> {
        let BatchShape { action_len, segment_actions_len, .. } = self.shape;
        let previous = self.on_device(&batch.previous_actions)?;
        let first = (u.narrow(1, 0, action_len)? - previous)?;
        let mut changes = first.broadcast_mul(&self.on_device(&batch.has_previous)?)?;
        let len = segment_actions_len - action_len;
        if len > 0 {
            let others = (u.narrow(1, action_len, len)? - u.narrow(1, 0, len)?)?;
            changes = Tensor::cat(&[&changes, &others], 1)?;
        }
        changes.sqr()?.sum(1)?.mean_all()
    }

    /// Does one step of network `name` on `loss`.
    fn descend(&mut self, name: &str, loss: &Tensor, target_step: bool) -> Result<()> {
        let gradients = loss.backward()?;
        let Some(gradient) = gradients.get(&self.device_network(name)?.parameters) else {
            candle_core::bail!("the loss does not depend on {name}");
        };
        self.step(name, gradient.detach(), target_step)
    }

    /// Does one step of Adam. With `target_step`, it also moves the target, if there is one.
    fn step(&mut self, name: &str, gradient: Tensor, target_step: bool) -> Result<()> {
        let polyak = self.config.algorithm.polyak;
        let Some(network) = self.networks.iter_mut().find(|network| network.name == name) else {
            candle_core::bail!("the device has no network {name}");
        };
        network.step += 1;
        let correction = |beta: f32| 1.0 - f64::from(beta).powf(network.step as f64);
        let [first, second] = &network.moments;
        let (beta1, beta2) = (f64::from(BETA1), f64::from(BETA2));
        let first = ((first * beta1)? + (&gradient * (1.0 - beta1))?)?;
        let second = ((second * beta2)? + (gradient.sqr()? * (1.0 - beta2))?)?;
        let root = (second.sqrt()? / correction(BETA2).sqrt())?;
        let change = (&first / (root + f64::from(EPSILON))?)?;
        let change = (change * (network.learning_rate / correction(BETA1)))?;
        let parameters = (network.parameters.as_detached_tensor() - change)?.detach();
        network.parameters.set(&parameters)?;
        if let Some(target) = network.target.as_ref().filter(|_| target_step) {
            let old = target.as_detached_tensor();
            target.set(&(&old + ((parameters - &old)? * polyak)?)?.detach())?;
        }
        network.moments = [first.detach(), second.detach()];
        network.gradient = Some(gradient);
        Ok(())
    }
}

impl DeviceNetwork {
    fn new(name: &'static str, network: &TrainableNetwork, device: &Device) -> Result<Self> {
        let to = |values: &[f32]| Tensor::from_slice(values, values.len(), device);
        let var = |values: &[f32]| Var::from_tensor(&to(values)?);
        let moments = &network.adam.moments;
        Ok(Self {
            name,
            shape: network.shape.clone(),
            layer_norm: network.layer_norm.clone(),
            parameters: var(network.parameters.values())?,
            target: match &network.target {
                Some(target) => Some(var(target.values())?),
                None => None,
            },
            moments: [to(&moments.first)?, to(&moments.second)?],
            step: network.adam.step.0,
            learning_rate: network.adam.learning_rate(),
            gradient: None,
        })
    }
}
