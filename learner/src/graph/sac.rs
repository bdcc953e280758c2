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
        let temperature = graph.temperature()?;
        let next = graph.means(Of::Target, &batch.next_states)?;
        let (u, density) = next.draw(&batch.next_noise)?;
        let inputs = graph.critic_inputs(&batch.next_states, &next.with_end_state(&u)?)?;
        let q = graph.smallest_q(&CRITICS, Of::Target, &inputs)?;
        let values = (q - density.broadcast_mul(&temperature)?)?;
        let critics = graph.fit_critics(&CRITICS, batch, &values, true)?;

        let means = graph.means(Of::Network, &batch.states)?;
        let (u, density) = means.draw(&batch.noise)?;
        let inputs = graph.critic_inputs(&batch.states, &means.with_end_state(&u)?)?;
        let q = graph.smallest_q(&CRITICS, Of::Frozen, &inputs)?;
        let penalty = graph.action_rate_penalty(&means.means.tanh()?, batch, critics.q_size)?;
        let loss = ((density.broadcast_mul(&temperature)? - q)?.mean_all()? + penalty)?;
        graph.descend("actor", &loss, false)?;
        let entropy = graph.temperature_step(&density)?;

        let mut losses = critics.losses(Some(loss.to_scalar()?));
        losses.entropy = Some(entropy);
        losses.temperature = Some(temperature.to_vec1()?[0]);
        Ok(losses)
    }
}

impl Graph {
    /// Returns the weight of the entropy, (1,), without gradients.
    pub(super) fn temperature(&self) -> Result<Tensor> {
        self.network("log_temperature")?.parameters.exp()
    }

    /// Does a step of the temperature towards the target entropy, with log pi of drawn actions,
    /// (B, 1). Returns the entropy.
    pub(super) fn temperature_step(&mut self, density: &Tensor) -> Result<f32> {
        let entropy = -density.mean_all()?.to_scalar::<f32>()?;
        let per_action = self.config.algorithm.sac.target_entropy_per_action;
        let wanted = (per_action * self.shape.segment_actions_len as f64) as f32;
        // The gradient of -log temperature (mean log pi + target entropy).
        let gradient = Tensor::new(&[entropy - wanted], &self.device)?;
        self.step("log_temperature", gradient, false)?;
        Ok(entropy)
    }
}
