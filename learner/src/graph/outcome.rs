//! The outcome model as a graph (`algorithms::outcome`).

use candle_core::{D, Result, Tensor};

use super::Graph;
use super::policy::{DeviceStates, mlp};
use crate::algorithms::batch::Batch;

/// Outcomes of segments.
pub(super) struct Prediction {
    /// a_k - a_0 in thresholds of the goal, (B, K, G).
    motion: Tensor,
    /// Inputs of the critics that follow from it, (B, F).
    pub(super) features: Tensor,
}

impl Graph {
    /// Returns d_0 of observations, (B, 1, G), if there is a model.
    pub(super) fn goal_distances(&self, observations: &[f32]) -> Result<Option<Tensor>> {
        let Some(outcome) = self.shape.outcome else { return Ok(None) };
        let rows = observations.chunks_exact(self.shape.observation_len);
        let starts = rows
            .flat_map(|row| (0..outcome.goal_len).map(move |index| outcome.start(row, index)))
            .collect();
        Tensor::from_vec(starts, (self.shape.rows, 1, outcome.goal_len), &self.device).map(Some)
    }

    /// Predicts outcomes from critic inputs without features, if there is a model.
    pub(super) fn predict(
        &self,
        inputs: &Tensor,
        states: &DeviceStates,
    ) -> Result<Option<Prediction>> {
        let (Some(outcome), Some(starts)) = (self.shape.outcome, &states.goal_distances) else {
            return Ok(None);
        };
        let model = self.device_network("outcome_model")?;
        let inputs = inputs.narrow(1, 0, self.shape.observation_len + self.shape.actions_len)?;
        let motion = mlp(&model.shape, None, &model.parameters, &inputs)?;
        let motion = motion.reshape((self.shape.rows, outcome.steps, outcome.goal_len))?;
        let distances = starts.broadcast_sub(&motion)?;
        let length = distances.sqr()?.sum_keepdim(D::Minus1)?.sqrt()?;
        let features = Tensor::cat(
            &[(&distances / 4.0)?, (&distances / 2.0)?.tanh()?, (length - 1.0)?.tanh()?],
            D::Minus1,
        )?;
        Ok(Some(Prediction { motion, features: features.flatten_from(1)? }))
    }

    /// Does a step of the model on the batch's own actions, if there is one. Returns its prediction
    /// before the step.
    pub(super) fn outcome_step(
        &mut self,
        states: &DeviceStates,
        batch: &Batch,
    ) -> Result<Option<Prediction>> {
        let inputs = self.on_device(&batch.critic_inputs)?;
        let Some(prediction) = self.predict(&inputs, states)? else { return Ok(None) };
        let wanted = self.on_device(&batch.motion)?;
        let loss = (prediction.motion.flatten_from(1)? - wanted)?.sqr()?.mean_all()?;
        self.descend("outcome_model", &loss, false)?;
        Ok(Some(prediction))
    }
}
