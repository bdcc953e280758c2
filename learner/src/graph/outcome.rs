//! The outcome model as a graph (`algorithms::outcome`).

use candle_core::{D, Result, Tensor};

use super::batch::{DeviceBatch, needed};
use super::policy::DeviceStates;
use super::{Graph, Of};

/// Outcomes of segments.
pub(super) struct Prediction {
    /// a_k - a_0 in thresholds of the goal, (B, K, G).
    motion: Tensor,
    /// Inputs of the critics that follow from it, (B, F).
    pub(super) features: Tensor,
}

impl Graph {
    /// Returns d_0 of observations, (B, G). Empty without a model.
    pub(super) fn goal_distances(&self, observations: &[f32]) -> Vec<f32> {
        let Some(outcome) = self.shape.outcome else { return Vec::new() };
        let rows = observations.chunks_exact(self.shape.observation_len);
        rows.flat_map(|row| (0..outcome.goal_len).map(move |index| outcome.start(row, index)))
            .collect()
    }

    /// Predicts outcomes from critic inputs without features, if there is a model.
    pub(super) fn predict(
        &self,
        of: Of,
        inputs: &Tensor,
        states: &DeviceStates,
    ) -> Result<Option<Prediction>> {
        let (Some(outcome), Some(starts)) = (self.shape.outcome, &states.goal_distances) else {
            return Ok(None);
        };
        let motion = self.forward("outcome_model", of, &self.model_inputs(inputs)?)?;
        let motion = motion.reshape((self.shape.rows, outcome.steps, outcome.goal_len))?;
        let distances = starts.broadcast_sub(&motion)?;
        let length = distances.sqr()?.sum_keepdim(D::Minus1)?.sqrt()?;
        let features = Tensor::cat(
            &[(&distances / 4.0)?, (&distances / 2.0)?.tanh()?, (length - 1.0)?.tanh()?],
            D::Minus1,
        )?;
        Ok(Some(Prediction { motion, features: features.flatten_from(1)? }))
    }

    /// Returns the states and actions of critic inputs. A GPU multiplies no rows with gaps, which a
    /// carried end state would leave.
    pub(super) fn model_inputs(&self, critic_inputs: &Tensor) -> Result<Tensor> {
        let len = self.shape.observation_len + self.shape.actions_len;
        critic_inputs.narrow(1, 0, len)?.contiguous()
    }

    /// Does a step of the model on the batch's own actions, if there is one, and appends its
    /// prediction before the step to the critic inputs.
    pub(super) fn outcome_step(&mut self, batch: &mut DeviceBatch) -> Result<()> {
        let Some(prediction) = self.predict(Of::Network, &batch.critic_inputs, &batch.states)?
        else {
            return Ok(());
        };
        let motion = needed(&batch.motion, "motion")?;
        let loss = (prediction.motion.flatten_from(1)? - motion)?.sqr()?.mean_all()?;
        self.descend("outcome_model", &loss, false)?;
        let features = prediction.features.detach();
        batch.critic_inputs = Tensor::cat(&[&batch.critic_inputs, &features], D::Minus1)?;
        Ok(())
    }
}
