//! DDPG as a graph; see `algorithms::ddpg` for paper and differences.

use candle_core::Result;

use super::batch::DeviceBatch;
use super::{Graph, GraphAlgorithm, Of};
use crate::algorithms::losses::Losses;

#[derive(Debug)]
pub(super) struct Ddpg;

impl GraphAlgorithm for Ddpg {
    fn update(&self, graph: &mut Graph, batch: &DeviceBatch, _: u64) -> Result<Losses> {
        let next = graph.means(Of::Target, &batch.next_states)?;
        let actions = next.with_end_state(&next.means.tanh()?)?;
        let inputs = graph.critic_inputs(&batch.next_states, &actions)?;
        let values = graph.forward("critic", Of::Target, &inputs)?;
        let critics = graph.fit_critics(&["critic"], batch, &values, true)?;
        let loss = graph.policy_gradient_step("critic", batch, critics.q_size)?;
        Ok(critics.losses(Some(loss)))
    }
}
