//! SAC as a graph; see `algorithms::sac` for paper and differences.

use candle_core::{Result, Tensor};

use super::batch::{DeviceBatch, needed};
use super::losses::DeviceLosses;
use super::{CriticStep, Graph, GraphAlgorithm, Of};

const CRITICS: [&str; 2] = ["critic_1", "critic_2"];

#[derive(Debug)]
pub(super) struct Sac;

impl GraphAlgorithm for Sac {
    fn update(&self, graph: &mut Graph, batch: &DeviceBatch, _: u64) -> Result<DeviceLosses> {
        let next = graph.next_draw(batch)?;
        let q = graph.smallest_q(&CRITICS, Of::Target, &next.critic_inputs)?;
        let values = (q - next.entropy_cost)?;
        let critic_step = graph.fit_critics(&CRITICS, batch, &values, true)?;
        graph.soft_actor_step(batch, critic_step, |graph, inputs| {
            graph.smallest_q(&CRITICS, Of::Frozen, inputs)
        })
    }
}

/// Actions that the policy draws after a batch's windows.
pub(super) struct NextDraw {
    /// States and actions, (B, critic inputs).
    pub(super) critic_inputs: Tensor,
    /// Temperature times log pi of the actions, (B, 1).
    pub(super) entropy_cost: Tensor,
}

impl Graph {
    /// Draws the actions after the windows, without gradients.
    pub(super) fn next_draw(&self, batch: &DeviceBatch) -> Result<NextDraw> {
        let means = self.means(Of::Target, &batch.next_states)?;
        let (u, density) = means.draw(needed(&batch.next_noise, "next_noise")?)?;
        Ok(NextDraw {
            critic_inputs: self.critic_inputs(&batch.next_states, &means.with_end_state(&u)?)?,
            entropy_cost: density.broadcast_mul(&self.temperature()?)?,
        })
    }

    /// Does an actor step on temperature log pi(u|s) - `value`(s, u), u ~ pi(s), plus the penalties
    /// on the means, and a step of the temperature towards the target entropy. Returns the losses
    /// of the whole update.
    pub(super) fn soft_actor_step(
        &mut self,
        batch: &DeviceBatch,
        CriticStep { losses, q_size }: CriticStep,
        value: impl Fn(&Self, &Tensor) -> Result<Tensor>,
    ) -> Result<DeviceLosses> {
        let temperature = self.temperature()?;
        let means = self.means(Of::Network, &batch.states)?;
        let (u, density) = means.draw(needed(&batch.noise, "noise")?)?;
        let inputs = self.critic_inputs(&batch.states, &means.with_end_state(&u)?)?;
        let soft = (density.broadcast_mul(&temperature)? - value(self, &inputs)?)?.mean_all()?;
        let mean_u = means.means.tanh()?;
        let loss = (soft + self.penalties(&means, &mean_u, batch, &q_size)?)?;
        self.descend("actor", &loss, false)?;

        let entropy = density.detach().mean_all()?.neg()?;
        let per_action = self.config.algorithm.sac.target_entropy_per_action;
        let wanted = per_action * self.shape.segment_actions_len as f64;
        // The gradient of -log temperature (mean log pi + target entropy).
        let gradient = (entropy.reshape(1)? - wanted)?;
        self.step("log_temperature", &gradient, false)?;
        Ok(DeviceLosses {
            actor_loss: Some(loss),
            entropy: Some(entropy),
            temperature: Some(temperature),
            ..losses
        })
    }

    /// Returns the weight of the entropy, (1,), without gradients.
    fn temperature(&self) -> Result<Tensor> {
        self.network("log_temperature")?.parameters.exp()
    }
}
