//! A batch on the device.

use candle_core::{Result, Tensor};
use dmprl_shared::policy::{Head, Policy};

use super::Graph;
use super::policy::DeviceStates;
use crate::algorithms::batch::Batch;

/// The tensors of a [`Batch`].
#[derive(Debug)]
pub(super) struct DeviceBatch {
    /// s_t.
    pub(super) states: DeviceStates,
    /// The states from which targets bootstrap.
    pub(super) next_states: DeviceStates,
    /// Critic inputs with the batch's own actions, (B, critic inputs).
    pub(super) critic_inputs: Tensor,
    /// Standard normal noise for the actions after the window, (B, K A), or (B, 0).
    pub(super) next_noise: Tensor,
    /// Standard normal noise for the actor's own actions, (B, K A), or (B, 0).
    pub(super) noise: Tensor,
    /// u_{t-1}, (B, A).
    pub(super) previous_actions: Tensor,
    /// 1 if u_{t-1} exists, else 0, (B, 1).
    pub(super) has_previous: Tensor,
    /// Motion of the achieved goal, (B, K G), for the outcome model.
    pub(super) motion: Tensor,
    rewards: Tensor,
    bootstrap: Tensor,
    target_range: [f32; 2],
}

impl DeviceBatch {
    /// Returns reward + bootstrap * `next_values` without gradients, for (B, N) values, within the
    /// range that the rewards allow.
    pub(super) fn targets(&self, next_values: &Tensor) -> Result<Tensor> {
        let values = next_values.broadcast_mul(&self.bootstrap)?;
        let [low, high] = self.target_range;
        Ok(values.broadcast_add(&self.rewards)?.clamp(low, high)?.detach())
    }
}

impl Graph {
    /// Copies a batch to the device.
    pub(super) fn batch(&self, policy: &Policy, batch: &Batch) -> Result<DeviceBatch> {
        Ok(DeviceBatch {
            states: self.states(policy, &batch.observations, &batch.inputs)?,
            next_states: self.states(policy, &batch.next_observations, &batch.next_inputs)?,
            critic_inputs: self.rows(&batch.critic_inputs)?,
            next_noise: self.rows(&batch.next_noise)?,
            noise: self.rows(&batch.noise)?,
            previous_actions: self.rows(&batch.previous_actions)?,
            has_previous: self.rows(&batch.has_previous)?,
            motion: self.rows(&batch.motion)?,
            rewards: self.rows(&batch.rewards)?,
            bootstrap: self.rows(&batch.bootstrap)?,
            target_range: batch.target_range,
        })
    }

    fn rows(&self, values: &[f32]) -> Result<Tensor> {
        let rows = self.shape.rows;
        Tensor::from_slice(values, (rows, values.len() / rows), &self.device)
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
            inputs: self.rows(inputs)?,
            starts: Tensor::from_vec(starts, (rows, 2), &self.device)?,
            goal_distances: self.goal_distances(observations)?,
        })
    }
}
