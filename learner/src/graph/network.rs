//! A network with its target and optimiser on the device.
//!
//! Optimiser and target handle the parameters as one vector. Gradients are computed for its parts,
//! the variables. candle would pad the gradient of each part to the length of the vector. All of
//! them are written in place, as a recorded update requires (`recording`).

use candle_core::{Device, Result, Tensor, Var};
use dmprl_shared::policy::MlpShape;

use super::modules::Variable;
use super::{FACTORS, Of};
use crate::update::kernels::{BETA1, BETA2, EPSILON};
use crate::update::network::TrainableNetwork;

/// A network.
#[derive(Debug)]
pub(super) struct DeviceNetwork {
    pub(super) name: &'static str,
    pub(super) shape: MlpShape,
    /// Whether the network is built with candle-nn.
    pub(super) is_module: bool,
    /// Parts of the parameters, which follow each other.
    pub(super) variables: Vec<Variable>,
    /// Copies of the parts, which have gradients.
    leaves: Vec<Var>,
    /// All parameters, (P,).
    pub(super) parameters: Tensor,
    target: Option<Tensor>,
    moments: [Tensor; 2],
    /// Steps of Adam.
    pub(super) step: u64,
    learning_rate: f64,
    /// Gradient of the last step, (P,).
    gradient: Tensor,
}

impl DeviceNetwork {
    /// Copies a network from the host. `variables` are those of candle-nn, if it is built with it.
    pub(super) fn new(
        name: &'static str,
        network: &TrainableNetwork,
        variables: Option<Vec<Variable>>,
        device: &Device,
    ) -> Result<Self> {
        let to = |values: &[f32]| Tensor::from_slice(values, values.len(), device);
        let moments = &network.adam.moments;
        let is_module = variables.is_some();
        let variables = variables
            .unwrap_or_else(|| Variable::of_mlp(&network.shape, network.layer_norm.as_ref()));
        let parameters = to(network.parameters.values())?;
        let leaves = variables.iter().map(|part| Var::from_tensor(&part.view(&parameters)?));
        let leaves = leaves.collect::<Result<_>>()?;
        Ok(Self {
            is_module,
            variables,
            leaves,
            parameters,
            name,
            shape: network.shape.clone(),
            target: network.target.as_ref().map(|target| to(target.values())).transpose()?,
            moments: [to(&moments.first)?, to(&moments.second)?],
            step: network.adam.step.0,
            learning_rate: network.adam.learning_rate(),
            gradient: to(network.gradient())?,
        })
    }

    /// Copies parameters, target and optimiser back to the host.
    pub(super) fn fetch(&self, network: &mut TrainableNetwork) -> Result<()> {
        network.parameters.set(&self.parameters.to_vec1::<f32>()?)?;
        if let (Some(own), Some(target)) = (&mut network.target, &self.target) {
            own.set(&target.to_vec1::<f32>()?)?;
        }
        network.adam.moments.first = self.moments[0].to_vec1()?;
        network.adam.moments.second = self.moments[1].to_vec1()?;
        network.adam.step.0 = self.step;
        network.set_gradient(&self.gradient.to_vec1::<f32>()?);
        Ok(())
    }

    /// Returns the network's variables in order. Without a target network, `Of::Target` is
    /// `Of::Frozen`.
    pub(super) fn tensors(&self, of: Of) -> Result<Vec<Tensor>> {
        let flat = match (of, &self.target) {
            (Of::Network, _) => {
                return Ok(self.leaves.iter().map(|leaf| leaf.as_tensor().clone()).collect());
            }
            (Of::Target, Some(target)) => target,
            (Of::Target, None) | (Of::Frozen, _) => &self.parameters,
        };
        self.variables.iter().map(|part| part.view(flat)).collect()
    }

    /// Returns the gradient of `loss`, (P,).
    ///
    /// # Errors
    /// If a variable has no gradient, or a device operation fails.
    pub(super) fn gradient_of(&self, loss: &Tensor) -> Result<Tensor> {
        let gradients = loss.backward()?;
        let parts = self.leaves.iter().enumerate().map(|(index, leaf)| match gradients.get(leaf) {
            Some(gradient) => gradient.flatten_all(),
            None => candle_core::bail!(
                "{}: the loss has no gradient for variable {index}; use only operations that have \
                 one (modules::layer_norm, not candle_nn's)",
                self.name
            ),
        });
        Ok(Tensor::cat(&parts.collect::<Result<Vec<_>>>()?, 0)?.detach())
    }

    /// Returns the factors of the next step, which depend on its number: that of the second
    /// moment's root, and that of the change.
    pub(super) fn next_factors(&self) -> [f32; FACTORS] {
        let correction = |beta: f32| 1.0 - f64::from(beta).powf(self.step as f64 + 1.0);
        let change = self.learning_rate / correction(BETA1);
        [(1.0 / correction(BETA2).sqrt()) as f32, change as f32]
    }

    /// Does one step of Adam with [`DeviceNetwork::next_factors`], ([`FACTORS`],). With `polyak`,
    /// it also moves the target, if there is one.
    pub(super) fn descend(
        &mut self,
        gradient: &Tensor,
        factors: &Tensor,
        polyak: Option<f64>,
    ) -> Result<()> {
        self.step += 1;
        let [first, second] = &self.moments;
        let (beta1, beta2) = (f64::from(BETA1), f64::from(BETA2));
        let new_first = ((first * beta1)? + (gradient * (1.0 - beta1))?)?;
        let new_second = ((second * beta2)? + (gradient.sqr()? * (1.0 - beta2))?)?;
        let root = new_second.sqrt()?.broadcast_mul(&factors.narrow(0, 0, 1)?)?;
        let change = (&new_first / (root + f64::from(EPSILON))?)?;
        let change = change.broadcast_mul(&factors.narrow(0, 1, 1)?)?;
        let parameters = (&self.parameters - change)?;
        for (leaf, part) in self.leaves.iter().zip(&self.variables) {
            leaf.set(&part.view(&parameters)?)?;
        }
        if let (Some(target), Some(polyak)) = (&self.target, polyak) {
            let moved = (target + ((&parameters - target)? * polyak)?)?;
            target.slice_set(&moved, 0, 0)?;
        }
        first.slice_set(&new_first, 0, 0)?;
        second.slice_set(&new_second, 0, 0)?;
        self.parameters.slice_set(&parameters, 0, 0)?;
        self.gradient.slice_set(gradient, 0, 0)
    }
}
