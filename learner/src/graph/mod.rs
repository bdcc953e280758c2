//! The update as a graph of candle tensors with automatic differentiation: what runs on a GPU.
//!
//! On the processor the kernels of `update` do the same several times faster; tests there hold the
//! two to each other, losses, gradients and parameters. Unlike theirs, candle's operations allocate
//! their outputs.

mod policy;

use candle_core::{D, Device, Result, Tensor, Var};
use dmprl_shared::config::{AlgorithmName, ExperimentConfig};
use dmprl_shared::policy::{Head, MlpShape, Policy};

use crate::algorithms::{Batch, BatchShape, Losses};
use crate::update::kernels::{BETA1, BETA2, EPSILON};
use crate::update::layer_norm::LayerNorm;
use crate::update::trained::Trained;
use policy::{PolicyGraph, StatesOn, network};

/// A network with target and optimiser on the device.
#[derive(Debug)]
struct Remote {
    name: &'static str,
    shape: MlpShape,
    layer_norm: Option<LayerNorm>,
    network: Var,
    target: Option<Var>,
    moments: [Tensor; 2],
    step: u64,
    learning_rate: f64,
    /// Of the last step.
    gradient: Option<Tensor>,
}

/// The networks of an algorithm and its update on a device.
#[derive(Debug)]
pub struct Graph {
    config: ExperimentConfig,
    shape: BatchShape,
    device: Device,
    policy: PolicyGraph,
    networks: Vec<Remote>,
}

impl Graph {
    /// Takes the networks over from the host.
    ///
    /// # Errors
    /// If the device refuses something.
    pub fn new(
        config: &ExperimentConfig,
        policy: &Policy,
        shape: BatchShape,
        device: &Device,
        networks: &[(&'static str, &Trained)],
    ) -> Result<Self> {
        let networks = networks.iter().map(|(name, trained)| Remote::new(name, trained, device));
        Ok(Self {
            config: config.clone(),
            shape,
            device: device.clone(),
            policy: PolicyGraph::new(config, policy, device)?,
            networks: networks.collect::<Result<_>>()?,
        })
    }

    /// Brings one network, its target and its optimiser back to the host.
    ///
    /// # Errors
    /// If the device refuses something.
    pub fn fetch(&self, name: &str, trained: &mut Trained) -> Result<()> {
        let remote = self.remote(name)?;
        trained.network.set(&remote.network.to_vec1::<f32>()?)?;
        if let (Some(own), Some(target)) = (&mut trained.target, &remote.target) {
            own.set(&target.to_vec1::<f32>()?)?;
        }
        trained.adam.moments.first = remote.moments[0].to_vec1()?;
        trained.adam.moments.second = remote.moments[1].to_vec1()?;
        trained.adam.step.0 = remote.step;
        if let Some(gradient) = &remote.gradient {
            trained.set_gradient(&gradient.to_vec1::<f32>()?);
        }
        Ok(())
    }

    /// Copies the actor's parameters into `out`.
    ///
    /// # Errors
    /// If the device refuses.
    pub fn read_actor(&self, out: &mut [f32]) -> Result<()> {
        out.copy_from_slice(&self.remote("actor")?.network.to_vec1::<f32>()?);
        Ok(())
    }

    fn remote(&self, name: &str) -> Result<&Remote> {
        match self.networks.iter().find(|remote| remote.name == name) {
            Some(remote) => Ok(remote),
            None => candle_core::bail!("no network {name} on the device"),
        }
    }

    fn q(&self, name: &str, of_target: bool, inputs: &Tensor) -> Result<Tensor> {
        let remote = self.remote(name)?;
        let layer_norm = remote.layer_norm.as_ref();
        match (&remote.target, of_target) {
            (Some(target), true) => {
                network(&remote.shape, layer_norm, &target.as_detached_tensor(), inputs)
            }
            _ => network(&remote.shape, layer_norm, &remote.network, inputs),
        }
    }

    /// Critics of the algorithm, the first first.
    fn critics(&self) -> &'static [&'static str] {
        match self.config.algorithm.name {
            AlgorithmName::Ddpg => &["critic"],
            _ => &["critic_1", "critic_2"],
        }
    }

    /// Update number `update`, counted from 1, as the file of the algorithm describes it.
    ///
    /// # Errors
    /// If the device refuses something.
    pub fn update(&mut self, policy: &Policy, batch: &Batch, update: u64) -> Result<Losses> {
        let td3 = &self.config.algorithm.td3;
        let whole = self.config.algorithm.name != AlgorithmName::Td3
            || update.is_multiple_of(td3.actor_interval);
        let states = self.states(policy, &batch.observations, &batch.inputs)?;
        let temperature = self.temperature()?;
        let (critic_loss, q_mean, q_size) =
            self.critics_step(policy, batch, &temperature, whole)?;
        let mut losses = Losses { critic_loss, q_mean, ..Losses::default() };
        if whole {
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
            AlgorithmName::Sac => {
                Ok(Some(self.remote("log_temperature")?.network.as_detached_tensor().exp()?))
            }
            _ => Ok(None),
        }
    }

    fn on_device(&self, values: &[f32]) -> Result<Tensor> {
        Tensor::from_slice(values, (self.shape.rows, values.len() / self.shape.rows), &self.device)
    }

    fn states(&self, policy: &Policy, observations: &[f32], inputs: &[f32]) -> Result<StatesOn> {
        let starts = match policy.head() {
            Head::Dmp(head) => head.starts(observations),
            Head::Mlp => Vec::new(),
        };
        let rows = starts.len() / 2;
        Ok(StatesOn {
            inputs: self.on_device(inputs)?,
            starts: Tensor::from_vec(starts, (rows, 2), &self.device)?,
        })
    }

    /// The critic's input: states and what it sees of the actions.
    fn critic_inputs(&self, states: &StatesOn, acts: &Tensor) -> Result<Tensor> {
        let BatchShape { actions_len, segment_actions_len, .. } = self.shape;
        let seen = match actions_len < segment_actions_len {
            true => acts.narrow(1, 0, actions_len)?,
            false => acts.clone(),
        };
        Tensor::cat(&[&states.inputs, &seen], D::Minus1)
    }

    /// The smallest Q of the algorithm's critics.
    fn smallest_q(&self, of_target: bool, inputs: &Tensor) -> Result<Tensor> {
        let critics = self.critics();
        let mut q = self.q(critics[0], of_target, inputs)?;
        for critic in &critics[1..] {
            q = q.minimum(&self.q(critic, of_target, inputs)?)?;
        }
        Ok(q)
    }

    fn targets(
        &self,
        policy: &Policy,
        batch: &Batch,
        temperature: &Option<Tensor>,
    ) -> Result<Tensor> {
        let states = self.states(policy, &batch.next_observations, &batch.next_inputs)?;
        let actor = self.remote("actor")?;
        let of_target = actor.target.as_ref().unwrap_or(&actor.network).as_detached_tensor();
        let means = self.policy.means(&of_target, &states)?;
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
        let mut value = self.smallest_q(true, &inputs)?;
        if let Some(bonus) = bonus {
            value = (value - bonus)?;
        }
        let (rewards, bootstrap) =
            (self.on_device(&batch.rewards)?, self.on_device(&batch.bootstrap)?);
        Ok((rewards + bootstrap.mul(&value)?)?.detach())
    }

    fn critics_step(
        &mut self,
        policy: &Policy,
        batch: &Batch,
        temperature: &Option<Tensor>,
        follow: bool,
    ) -> Result<(f32, f32, f64)> {
        let targets = self.targets(policy, batch, temperature)?;
        let inputs = self.on_device(&batch.critic_inputs)?;
        let (mut sum, mut q_mean, mut q_size) = (0.0, 0.0, 0.0);
        for (index, critic) in self.critics().iter().enumerate() {
            let q = self.q(critic, false, &inputs)?;
            if index == 0 {
                q_mean = q.mean_all()?.to_scalar()?;
                q_size = f64::from(q.abs()?.mean_all()?.to_scalar::<f32>()?);
            }
            let loss = (q - &targets)?.sqr()?.mean_all()?;
            sum += loss.to_scalar::<f32>()?;
            self.descend(critic, &loss, follow)?;
        }
        Ok((sum, q_mean, q_size))
    }

    fn actor_step(
        &mut self,
        states: &StatesOn,
        batch: &Batch,
        temperature: &Option<Tensor>,
        penalty: f64,
    ) -> Result<(f32, Option<f32>)> {
        let means = self.policy.means(&self.remote("actor")?.network, states)?;
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

    /// Sum of the squared changes of u, (B, K A): a mean over the batch.
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

    fn descend(&mut self, name: &str, loss: &Tensor, follow: bool) -> Result<()> {
        let gradients = loss.backward()?;
        let Some(gradient) = gradients.get(&self.remote(name)?.network) else {
            candle_core::bail!("a loss that does not depend on {name}");
        };
        self.step(name, gradient.detach(), follow)
    }

    /// One step of Adam; the target follows, if that is asked for and there is one.
    fn step(&mut self, name: &str, gradient: Tensor, follow: bool) -> Result<()> {
        let polyak = self.config.algorithm.polyak;
        let Some(remote) = self.networks.iter_mut().find(|remote| remote.name == name) else {
            candle_core::bail!("no network {name} on the device");
        };
        remote.step += 1;
        let correction = |beta: f32| 1.0 - f64::from(beta).powf(remote.step as f64);
        let [first, second] = &remote.moments;
        let (beta1, beta2) = (f64::from(BETA1), f64::from(BETA2));
        let first = ((first * beta1)? + (&gradient * (1.0 - beta1))?)?;
        let second = ((second * beta2)? + (gradient.sqr()? * (1.0 - beta2))?)?;
        let root = (second.sqrt()? / correction(BETA2).sqrt())?;
        let change = (&first / (root + f64::from(EPSILON))?)?;
        let change = (change * (remote.learning_rate / correction(BETA1)))?;
        let network = (remote.network.as_detached_tensor() - change)?.detach();
        remote.network.set(&network)?;
        if let Some(target) = remote.target.as_ref().filter(|_| follow) {
            let old = target.as_detached_tensor();
            target.set(&(&old + ((network - &old)? * polyak)?)?.detach())?;
        }
        remote.moments = [first.detach(), second.detach()];
        remote.gradient = Some(gradient);
        Ok(())
    }
}

impl Remote {
    fn new(name: &'static str, trained: &Trained, device: &Device) -> Result<Self> {
        let to = |values: &[f32]| Tensor::from_slice(values, values.len(), device);
        let var = |values: &[f32]| Var::from_tensor(&to(values)?);
        let moments = &trained.adam.moments;
        Ok(Self {
            name,
            shape: trained.shape.clone(),
            layer_norm: trained.layer_norm.clone(),
            network: var(trained.network.values())?,
            target: match &trained.target {
                Some(target) => Some(var(target.values())?),
                None => None,
            },
            moments: [to(&moments.first)?, to(&moments.second)?],
            step: trained.adam.step.0,
            learning_rate: trained.adam.learning_rate(),
            gradient: None,
        })
    }
}
