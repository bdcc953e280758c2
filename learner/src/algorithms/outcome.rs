//! The outcome model: a network that predicts how a segment moves the achieved goal. The critics
//! see what follows for the distance to the desired goal.
//!
//! Without it, critics must find out two things from sparse rewards: how a segment moves an object,
//! and whether that is near the goal. The model learns the first from every window, whatever its
//! goal. The second can be computed. This is our own.
//!
//! The model's input is that of a critic: observation and actions. Its outputs are a_k - a_0 for
//! k = 1..K, where a_k is the achieved goal after step k. Its loss is the mean squared error.
//! Lengths are in units of the goal's threshold. With the desired goal g and d_k = g - a_k, the
//! critics see d_k / 4, tanh(d_k / 2) and tanh(|d_k| - 1). The sign of the last changes where the
//! reward does, if that depends on the Euclidean distance of all entries. The actor's gradient runs
//! through these features and the model.

use candle_core::Result;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::{Activations, MlpShape, initial_parameters};
use dmprl_shared::seeds;

use super::BatchShape;
use super::outcome_shape::OutcomeShape;
use crate::update::backward_pass::Gradients;
use crate::update::network::{NetworkView, PassRecord, TrainableNetwork};

/// Makes the configured model with newly drawn parameters.
///
/// # Errors
/// If the processor does not support the configured precision.
pub fn new_outcome_model(
    config: &ExperimentConfig,
    shape: BatchShape,
) -> Result<Option<TrainableNetwork>> {
    let Some(outcome) = shape.outcome else { return Ok(None) };
    let mut widths = vec![shape.observation_len + shape.actions_len];
    widths.extend(&config.algorithm.critic_hidden);
    widths.push(outcome.outputs());
    let layers = MlpShape::new(widths);
    let mut random = seeds::stream(config.run.seed, "outcome model parameters", 0);
    let initial = initial_parameters(&layers, &mut random);
    let (rate, precision) = (config.algorithm.critic_learning_rate, config.learner.precision);
    TrainableNetwork::new(layers, initial, rate, false, precision).map(Some)
}

/// The model's buffers for one shard.
#[derive(Debug)]
pub struct OutcomeBuffers {
    shape: OutcomeShape,
    layers: MlpShape,
    rows: usize,
    /// Observations as network inputs, and actions, (rows, O + K A).
    inputs: Vec<f32>,
    activations: Activations,
    gradients: Gradients,
    /// d_k of the last prediction, (rows, K G).
    distances: Vec<f32>,
    /// Gradient with respect to the features, (rows, F).
    features_gradient: Vec<f32>,
    /// Gradient with respect to the actions, (rows, K A).
    actions_gradient: Vec<f32>,
}

impl OutcomeBuffers {
    /// Allocates buffers for a model and `rows` rows.
    #[must_use]
    pub fn new(shape: BatchShape, model: &TrainableNetwork, rows: usize) -> Option<Self> {
        let (outcome, layers) = (shape.outcome?, &model.shape);
        Some(Self {
            shape: outcome,
            rows,
            inputs: vec![0.0; rows * layers.inputs()],
            activations: Activations::new(layers, rows),
            gradients: Gradients::new(layers, rows),
            distances: vec![0.0; rows * outcome.outputs()],
            features_gradient: vec![0.0; rows * outcome.features_len()],
            actions_gradient: vec![0.0; rows * shape.actions_len],
            layers: layers.clone(),
        })
    }

    /// Predicts from critic inputs, (rows, `width`), which begin with the model's inputs, and
    /// writes the features to the end of each row. `observations` are the same states in the units
    /// of the environment.
    pub fn predict(
        &mut self,
        model: &NetworkView<'_>,
        observations: &[f32],
        critic_inputs: &mut [f32],
        width: usize,
    ) {
        let (own, outputs) = (self.layers.inputs(), self.shape.outputs());
        let rows = self.inputs.chunks_exact_mut(own).zip(critic_inputs.chunks_exact(width));
        rows.for_each(|(own, critic)| own.copy_from_slice(&critic[..own.len()]));
        model.forward(&self.inputs, &mut self.activations, None);
        let motion = self.activations.output(&self.layers, self.rows);
        let observation_len = observations.len() / self.rows;
        for row in 0..self.rows {
            let observation = &observations[row * observation_len..(row + 1) * observation_len];
            let own = row * outputs..(row + 1) * outputs;
            let distances = &mut self.distances[own.clone()];
            for (index, (d, motion)) in distances.iter_mut().zip(&motion[own]).enumerate() {
                *d = self.shape.start(observation, index % self.shape.goal_len) - motion;
            }
            let features = &mut critic_inputs[row * width..(row + 1) * width];
            let features = &mut features[width - self.shape.features_len()..];
            self.shape.write_features(distances, features);
        }
        self.features_gradient.fill(0.0);
    }

    /// Runs the backward pass of the loss mean (prediction - motion)², a share of a batch of
    /// `batch_rows` rows. Call it after [`OutcomeBuffers::predict`].
    pub fn loss_backward(&mut self, model: &NetworkView<'_>, motion: &[f32], batch_rows: f32) {
        let factor = 2.0 / (batch_rows * self.shape.outputs() as f32);
        let predicted = self.activations.output(&self.layers, self.rows);
        let out = self.gradients.output_mut(&self.layers, self.rows);
        for (out, (predicted, motion)) in out.iter_mut().zip(predicted.iter().zip(motion)) {
            *out = factor * (predicted - motion);
        }
        model.backward_pass(&self.activations, None, self.rows).run(&mut self.gradients);
    }

    /// Adds one critic's gradient with respect to the features of `row`.
    pub fn add_features_gradient(&mut self, row: usize, gradient: &[f32]) {
        let len = self.shape.features_len();
        let sums = &mut self.features_gradient[row * len..(row + 1) * len];
        sums.iter_mut().zip(gradient).for_each(|(sum, gradient)| *sum += gradient);
    }

    /// Returns the gradient with respect to the actions, (rows, K A), that runs through the
    /// features. Call it after [`OutcomeBuffers::add_features_gradient`].
    pub fn actions_gradient(&mut self, model: &NetworkView<'_>) -> &[f32] {
        let (outputs, features_len) = (self.shape.outputs(), self.shape.features_len());
        let out = self.gradients.output_mut(&self.layers, self.rows);
        for row in 0..self.rows {
            let own = row * outputs..(row + 1) * outputs;
            let features = &self.features_gradient[row * features_len..(row + 1) * features_len];
            let out = &mut out[own.clone()];
            self.shape.features_backward(&self.distances[own], features, out);
            // d_k = d_0 - prediction.
            out.iter_mut().for_each(|gradient| *gradient = -*gradient);
        }
        let pass = model.backward_pass(&self.activations, None, self.rows);
        pass.run(&mut self.gradients);
        let actions_len = self.actions_gradient.len() / self.rows;
        let first = self.layers.inputs() - actions_len;
        pass.input_gradient(&self.gradients, first, &mut self.actions_gradient);
        &self.actions_gradient
    }

    /// Returns the record of the model's passes.
    #[must_use]
    pub fn record(&self) -> PassRecord<'_> {
        PassRecord {
            inputs: &self.inputs,
            activations: &self.activations,
            normalised: None,
            gradients: &self.gradients,
        }
    }
}
