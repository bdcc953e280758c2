//! SAC as a graph; see `algorithms::sac` for paper and differences.

use candle_core::{Result, Tensor};

use super::batch::DeviceBatch;
use super::{Graph, GraphAlgorithm, Of};
use crate::algorithms::losses::Losses;

const CRITICS: [&str; 2] = ["critic_1", "critic_2"];

#[derive(Debug)]
pub(super) struct Sac;

impl GraphAlgorithm for Sac {
    fn update(&self, graph: &mut Graph, batch: &DeviceBatch, _: u64) -> Result<Losses> {
        let next = graph.next_draw(batch)?;
        let q = graph.smallest_q(&CRITICS, Of::Target, &next.critic_inputs)?;
        let critics = graph.fit_critics(&CRITICS, batch, &(q - next.entropy_cost)?, true)?;
        let mut losses = critics.losses(None);
        graph.soft_actor_step(batch, critics.q_size, &mut losses, |graph, inputs| {
            graph.smallest_q(&CRITICS, Of::Frozen, inputs)
        })?;
        Ok(losses)
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
        let (u, density) = means.draw(&batch.next_noise)?;
        Ok(NextDraw {
            critic_inputs: self.critic_inputs(&batch.next_states, &means.with_end_state(&u)?)?,
            entropy_cost: density.broadcast_mul(&self.temperature()?)?,
        })
    }

    /// Does an actor step on temperature log pi(u|s) - `value`(s, u), u ~ pi(s), plus the penalties
    /// on changes of the means, and a step of the temperature towards the target entropy.
    pub(super) fn soft_actor_step(
        &mut self,
        batch: &DeviceBatch,
        q_size: f64,
        losses: &mut Losses,
        value: impl Fn(&Self, &Tensor) -> Result<Tensor>,
    ) -> Result<()> {
        let temperature = self.temperature()?;
        let means = self.means(Of::Network, &batch.states)?;
        let (u, density) = means.draw(&batch.noise)?;
        let inputs = self.critic_inputs(&batch.states, &means.with_end_state(&u)?)?;
        let soft = (density.broadcast_mul(&temperature)? - value(self, &inputs)?)?.mean_all()?;
        let loss = (soft + self.action_penalties(&means.means.tanh()?, batch, q_size)?)?;
        self.descend("actor", &loss, false)?;

        let entropy = -density.mean_all()?.to_scalar::<f32>()?;
        let per_action = self.config.algorithm.sac.target_entropy_per_action;
        let wanted = (per_action * self.shape.segment_actions_len as f64) as f32;
        // The gradient of -log temperature (mean log pi + target entropy).
        let gradient = Tensor::new(&[entropy - wanted], &self.device)?;
        self.step("log_temperature", gradient, false)?;
        losses.actor_loss = Some(loss.to_scalar()?);
        losses.entropy = Some(entropy);
        losses.temperature = Some(temperature.to_vec1()?[0]);
        Ok(())
    }

    /// Returns the weight of the entropy, (1,), without gradients.
    fn temperature(&self) -> Result<Tensor> {
        self.network("log_temperature")?.parameters.exp()
    }
}
