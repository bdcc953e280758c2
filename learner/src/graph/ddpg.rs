//! DDPG as a graph; see `algorithms::ddpg` for paper and differences.

use candle_core::Result;

use super::batch::DeviceBatch;
use super::losses::DeviceLosses;
use super::{CriticStep, Graph, GraphAlgorithm, Of};

#[derive(Debug)]
pub(super) struct Ddpg;

impl GraphAlgorithm for Ddpg {
    fn update(&self, graph: &mut Graph, batch: &DeviceBatch, _: u64) -> Result<DeviceLosses> {
        let next = graph.means(Of::Target, &batch.next_states)?;
        let actions = next.with_end_state(&next.means.tanh()?)?;
        let inputs = graph.critic_inputs(&batch.next_states, &actions)?;
        let values = graph.forward("critic", Of::Target, &inputs)?;
        let CriticStep { losses, q_size } = graph.fit_critics(&["critic"], batch, &values, true)?;
        let loss = graph.policy_gradient_step("critic", batch, &q_size)?;
        Ok(DeviceLosses { actor_loss: Some(loss), ..losses })
    }
}
