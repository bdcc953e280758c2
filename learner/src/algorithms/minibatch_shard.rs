//! A shard of a rollout's minibatch, with the forward and backward passes of on-policy updates.

use dmprl_shared::policy::{Activations, Head, HeadGradient, MlpShape, Policy, PolicyWorkspace};

use super::ppo::{log_density, surrogate};
use crate::normaliser::Normaliser;
use crate::rollout_buffer::RolloutBuffer;
use crate::update::backward_pass::Gradients;
use crate::update::network::{NetworkView, PassRecord};

/// Quantities of the loss that all shards of a minibatch share.
#[derive(Debug, Clone, Copy)]
pub struct Objective<'a> {
    /// Logarithms of the policy's standard deviations, (A,).
    pub log_std: &'a [f32],
    /// Half-width of the interval to which ratios are clipped.
    pub clip: f32,
    /// Environment steps of the minibatch, over which the policy's loss is averaged.
    pub steps: f32,
    /// Segments of the minibatch, over which the value's loss is averaged.
    pub segments: f32,
}

/// Terms of the losses, summed over a shard's segments.
#[derive(Debug, Clone, Copy, Default)]
pub struct LossSums {
    /// The negative clipped objective of every step.
    pub policy: f32,
    /// (V - return)² of every segment.
    pub value: f32,
    /// Estimated divergence from the policy that acted, of every step.
    pub divergence: f32,
    /// Steps whose ratio lies outside the interval.
    pub outside: usize,
}

/// The source of a shard's segments.
#[derive(Debug, Clone, Copy)]
pub struct RolloutSource<'a> {
    /// The rollout.
    pub rollout: &'a RolloutBuffer,
    /// Log densities of all its steps under the policy that acted, (N, K).
    pub log_densities: &'a [f32],
    /// Normalises network inputs, if configured.
    pub normaliser: Option<&'a Normaliser>,
}

fn normalise(normaliser: Option<&Normaliser>, observations: &[f32], out: &mut [f32]) {
    let out = &mut out[..observations.len()];
    match normaliser {
        Some(normaliser) => normaliser.apply(observations, out),
        None => out.copy_from_slice(observations),
    }
}

/// Up to R segments, with all buffers of an update.
#[derive(Debug)]
pub struct MinibatchShard {
    observation_len: usize,
    action_len: usize,
    /// Numbers of a segment's actions, K A.
    actions_len: usize,
    value_shape: MlpShape,
    /// s in the units of environment and DMP, (R, O).
    observations: Vec<f32>,
    /// s as network input, normalised if configured, (R, O).
    inputs: Vec<f32>,
    /// Actions as drawn, (R, K, A).
    actions: Vec<f32>,
    /// Steps that were run, (R,).
    steps_len: Vec<usize>,
    /// Log densities under the policy that acted, (R, K).
    log_densities: Vec<f32>,
    advantages: Vec<f32>,
    returns: Vec<f32>,
    policy: PolicyWorkspace,
    actor_gradients: Gradients,
    value: Activations,
    value_gradients: Gradients,
    /// Gradient with respect to u, later to the head's means, (R, K, A).
    means_gradient: Vec<f32>,
    /// Gradient with respect to the logarithms of the standard deviations, (A,).
    pub log_std_gradient: Vec<f32>,
    /// Terms of the losses.
    pub sums: LossSums,
}

impl MinibatchShard {
    /// Allocates buffers for up to `rows` segments.
    #[must_use]
    pub fn new(policy: &Policy, value_shape: &MlpShape, rows: usize) -> Self {
        let layout = policy.layout();
        let actions_len = layout.actions_len();
        Self {
            observation_len: layout.observation_len,
            action_len: layout.action_len,
            actions_len,
            value_shape: value_shape.clone(),
            observations: Vec::with_capacity(rows * layout.observation_len),
            inputs: vec![0.0; rows * layout.observation_len],
            actions: Vec::with_capacity(rows * actions_len),
            steps_len: Vec::with_capacity(rows),
            log_densities: Vec::with_capacity(rows * layout.segment_steps),
            advantages: Vec::with_capacity(rows),
            returns: Vec::with_capacity(rows),
            policy: policy.workspace(rows),
            actor_gradients: Gradients::new(policy.shape(), rows),
            value: Activations::new(value_shape, rows),
            value_gradients: Gradients::new(value_shape, rows),
            means_gradient: vec![0.0; rows * actions_len],
            log_std_gradient: vec![0.0; layout.action_len],
            sums: LossSums::default(),
        }
    }

    fn rows(&self) -> usize {
        self.steps_len.len()
    }

    /// Returns the environment steps of the segments.
    #[must_use]
    pub fn steps(&self) -> usize {
        self.steps_len.iter().sum()
    }

    /// Copies these entries of a rollout.
    pub fn gather(&mut self, source: RolloutSource<'_>, entries: &[usize]) {
        let RolloutSource { rollout, log_densities, normaliser } = source;
        let (o, a) = (self.observation_len, self.actions_len);
        let k = a / self.action_len;
        for buffer in [&mut self.observations, &mut self.actions, &mut self.log_densities] {
            buffer.clear();
        }
        self.steps_len.clear();
        self.advantages.clear();
        self.returns.clear();
        for &entry in entries {
            self.observations.extend_from_slice(&rollout.observations[entry * o..(entry + 1) * o]);
            self.actions.extend_from_slice(&rollout.actions[entry * a..(entry + 1) * a]);
            self.log_densities.extend_from_slice(&log_densities[entry * k..(entry + 1) * k]);
            self.steps_len.push(rollout.steps_len[entry]);
            self.advantages.push(rollout.advantages[entry]);
            self.returns.push(rollout.returns[entry]);
        }
        normalise(normaliser, &self.observations, &mut self.inputs);
    }

    fn network_inputs(&self) -> &[f32] {
        &self.inputs[..self.observations.len()]
    }

    /// Computes the log densities of the gathered steps under the policy, (rows, K), into `out`.
    pub fn evaluate_log_densities(
        &mut self,
        policy: &Policy,
        actor: &NetworkView<'_>,
        log_std: &[f32],
        out: &mut [f32],
    ) {
        self.act(policy, actor);
        let steps = self.actions.chunks_exact(self.action_len);
        let means = self.policy.actions.chunks_exact(self.action_len);
        for ((action, mean), out) in steps.zip(means).zip(out) {
            *out = log_density(action, mean, log_std);
        }
    }

    /// Computes V of `observations`, (rows, O), into `out`, (rows,). Overwrites the gathered
    /// network inputs.
    pub fn evaluate_values(
        &mut self,
        value: &NetworkView<'_>,
        normaliser: Option<&Normaliser>,
        observations: &[f32],
        out: &mut [f32],
    ) {
        normalise(normaliser, observations, &mut self.inputs);
        value.forward(&self.inputs[..observations.len()], &mut self.value, None);
        out.copy_from_slice(self.value.output(&self.value_shape, out.len()));
    }

    fn act(&mut self, policy: &Policy, actor: &NetworkView<'_>) {
        actor.forward(&self.inputs[..self.observations.len()], &mut self.policy.activations, None);
        policy.decode(&self.observations, &mut self.policy);
    }

    /// Runs the passes of the policy's clipped loss.
    pub fn policy_backward(
        &mut self,
        policy: &Policy,
        actor: &NetworkView<'_>,
        objective: Objective<'_>,
    ) {
        self.act(policy, actor);
        self.sums = LossSums::default();
        self.log_std_gradient.fill(0.0);
        let used = self.rows() * self.actions_len;
        self.means_gradient[..used].fill(0.0);
        let k = self.actions_len / self.action_len;
        for row in 0..self.rows() {
            for step in row * k..row * k + self.steps_len[row] {
                self.policy_step_backward(step, self.advantages[row], objective);
            }
        }
        if policy.squashes() {
            for (gradient, action) in self.means_gradient.iter_mut().zip(&self.policy.actions) {
                *gradient *= 1.0 - action * action;
            }
        }
        let rows = self.rows();
        let outputs = self.actor_gradients.output_mut(policy.shape(), rows);
        if let (Head::Dmp(head), Some(dmp)) = (policy.head(), &mut self.policy.dmp) {
            let gradient = HeadGradient { means: &self.means_gradient[..used], end_state: &[] };
            head.backward(dmp, gradient, outputs, policy.shape().outputs());
        }
        let pass = actor.backward_pass(&self.policy.activations, None, rows);
        pass.run(&mut self.actor_gradients);
    }

    /// Adds one step's terms to the loss and its gradients.
    ///     d log density / d mean = z / std,   d log density / d log std = z² - 1,
    ///     z = (action - mean) / std
    fn policy_step_backward(&mut self, step: usize, advantage: f32, objective: Objective<'_>) {
        let Objective { log_std, clip, steps, .. } = objective;
        let at = step * self.action_len..(step + 1) * self.action_len;
        let (action, mean) = (&self.actions[at.clone()], &self.policy.actions[at.clone()]);
        let log_ratio = log_density(action, mean, log_std) - self.log_densities[step];
        let surrogate = surrogate(log_ratio, advantage, clip);
        self.sums.policy += surrogate.loss;
        self.sums.divergence += surrogate.divergence;
        self.sums.outside += usize::from(surrogate.outside);
        let slope = surrogate.slope / steps;
        let gradients = self.means_gradient[at].iter_mut().zip(&mut self.log_std_gradient);
        for (d, (of_mean, of_log_std)) in gradients.enumerate() {
            let precision = (-log_std[d]).exp();
            let z = (action[d] - mean[d]) * precision;
            *of_mean = slope * z * precision;
            *of_log_std += slope * (z * z - 1.0);
        }
    }

    /// Runs the passes of the value's loss, mean (V - return)².
    pub fn value_backward(&mut self, value: &NetworkView<'_>, objective: Objective<'_>) {
        let rows = self.rows();
        value.forward(&self.inputs[..self.observations.len()], &mut self.value, None);
        let values = self.value.output(&self.value_shape, rows);
        let out = self.value_gradients.output_mut(&self.value_shape, rows);
        for ((out, value), target) in out.iter_mut().zip(values).zip(&self.returns) {
            let error = value - target;
            *out = 2.0 * error / objective.segments;
            self.sums.value += error * error;
        }
        value.backward_pass(&self.value, None, rows).run(&mut self.value_gradients);
    }

    /// Returns the record for the actor. Call it after [`MinibatchShard::policy_backward`].
    #[must_use]
    pub fn actor_record(&self) -> PassRecord<'_> {
        PassRecord {
            inputs: self.network_inputs(),
            activations: &self.policy.activations,
            gradients: &self.actor_gradients,
            normalised: None,
        }
    }

    /// Returns the record for the value. Call it after [`MinibatchShard::value_backward`].
    #[must_use]
    pub fn value_record(&self) -> PassRecord<'_> {
        PassRecord {
            inputs: self.network_inputs(),
            activations: &self.value,
            gradients: &self.value_gradients,
            normalised: None,
        }
    }
}
