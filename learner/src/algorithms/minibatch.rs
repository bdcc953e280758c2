//! Some segments of a rollout on their way through policy and value: the passes that on-policy
//! updates are made of.

use dmprl_shared::policy::{Activations, Head, HeadGradient, MlpShape, Policy, PolicyWorkspace};

use super::ppo::{log_density, surrogate};
use crate::normaliser::Normaliser;
use crate::rollout_buffer::RolloutBuffer;
use crate::update::pass::Gradients;
use crate::update::trained::{Lent, Trace};

/// What all blocks of a minibatch share.
#[derive(Debug, Clone, Copy)]
pub struct Objective<'a> {
    /// Logarithms of the policy's standard deviations, (A,).
    pub log_std: &'a [f32],
    /// Half-width of the interval of ratios.
    pub clip: f32,
    /// Environment steps of the minibatch, over which the policy's loss is a mean.
    pub steps: f32,
    /// Segments of the minibatch, over which the value's is.
    pub segments: f32,
}

/// Sums over a block's segments, for the losses.
#[derive(Debug, Clone, Copy, Default)]
pub struct Sums {
    /// The clipped objective, negative, of every step.
    pub policy: f32,
    /// (V - return)² of every segment.
    pub value: f32,
    /// Estimated divergence from the policy that acted, of every step.
    pub divergence: f32,
    /// Steps whose ratio lies outside the interval.
    pub outside: usize,
}

/// Where a block's segments come from.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// The rollout.
    pub rollout: &'a RolloutBuffer,
    /// Of all its steps under the policy that acted, (N, K).
    pub log_densities: &'a [f32],
    /// What networks see observations through.
    pub normaliser: Option<&'a Normaliser>,
}

fn normalise(normaliser: Option<&Normaliser>, observations: &[f32], out: &mut [f32]) {
    let out = &mut out[..observations.len()];
    match normaliser {
        Some(normaliser) => normaliser.apply(observations, out),
        None => out.copy_from_slice(observations),
    }
}

/// Up to R segments with all buffers of an update.
#[derive(Debug)]
pub struct Block {
    observation_len: usize,
    action_len: usize,
    /// K A.
    actions_len: usize,
    value_shape: MlpShape,
    /// s as the environment and the DMP know it, (R, O).
    observations: Vec<f32>,
    /// s as the networks see it: normalised, where that is asked for, (R, O).
    inputs: Vec<f32>,
    /// As drawn, (R, K, A).
    actions: Vec<f32>,
    /// Steps really run, (R,).
    steps_len: Vec<usize>,
    /// Of the policy that acted, (R, K).
    log_densities: Vec<f32>,
    advantages: Vec<f32>,
    returns: Vec<f32>,
    policy: PolicyWorkspace,
    actor_gradients: Gradients,
    value: Activations,
    value_gradients: Gradients,
    /// With respect to u, then to the head's means, (R, K, A).
    means_gradient: Vec<f32>,
    /// With respect to the logarithms of the standard deviations, (A,).
    pub log_std_gradient: Vec<f32>,
    /// What the block adds to the losses.
    pub sums: Sums,
}

impl Block {
    /// Buffers for up to `rows` segments.
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
            sums: Sums::default(),
        }
    }

    fn rows(&self) -> usize {
        self.steps_len.len()
    }

    /// Environment steps of its segments.
    #[must_use]
    pub fn steps(&self) -> usize {
        self.steps_len.iter().sum()
    }

    /// Takes these entries of a rollout.
    pub fn gather(&mut self, source: Source<'_>, entries: &[usize]) {
        let Source { rollout, log_densities, normaliser } = source;
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

    fn seen(&self) -> &[f32] {
        &self.inputs[..self.observations.len()]
    }

    /// log densities of the gathered steps under the policy, (rows, K), into `out`.
    pub fn judge(&mut self, policy: &Policy, actor: &Lent<'_>, log_std: &[f32], out: &mut [f32]) {
        self.act(policy, actor);
        let steps = self.actions.chunks_exact(self.action_len);
        let means = self.policy.actions.chunks_exact(self.action_len);
        for ((action, mean), out) in steps.zip(means).zip(out) {
            *out = log_density(action, mean, log_std);
        }
    }

    /// V of observations, (rows, O), into `out`, (rows,); what was gathered is forgotten.
    pub fn appraise(
        &mut self,
        value: &Lent<'_>,
        normaliser: Option<&Normaliser>,
        observations: &[f32],
        out: &mut [f32],
    ) {
        normalise(normaliser, observations, &mut self.inputs);
        value.forward(&self.inputs[..observations.len()], &mut self.value, None);
        out.copy_from_slice(self.value.output(&self.value_shape, out.len()));
    }

    fn act(&mut self, policy: &Policy, actor: &Lent<'_>) {
        actor.forward(&self.inputs[..self.observations.len()], &mut self.policy.activations, None);
        policy.decode(&self.observations, &mut self.policy);
    }

    /// Passes of the policy's clipped loss.
    pub fn improve(&mut self, policy: &Policy, actor: &Lent<'_>, objective: Objective<'_>) {
        self.act(policy, actor);
        self.sums = Sums::default();
        self.log_std_gradient.fill(0.0);
        let used = self.rows() * self.actions_len;
        self.means_gradient[..used].fill(0.0);
        let k = self.actions_len / self.action_len;
        for row in 0..self.rows() {
            for step in row * k..row * k + self.steps_len[row] {
                self.improve_step(step, self.advantages[row], objective);
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
        actor.pass(&self.policy.activations, None, rows).backward(&mut self.actor_gradients);
    }

    /// One step's part in the loss and its gradients.
    ///     d log density / d mean = z / std,   d log density / d log std = z² - 1,
    ///     z = (action - mean) / std
    fn improve_step(&mut self, step: usize, advantage: f32, objective: Objective<'_>) {
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

    /// Passes of mean (V - return)².
    pub fn regress(&mut self, value: &Lent<'_>, objective: Objective<'_>) {
        let rows = self.rows();
        value.forward(&self.inputs[..self.observations.len()], &mut self.value, None);
        let values = self.value.output(&self.value_shape, rows);
        let out = self.value_gradients.output_mut(&self.value_shape, rows);
        for ((out, value), target) in out.iter_mut().zip(values).zip(&self.returns) {
            let error = value - target;
            *out = 2.0 * error / objective.segments;
            self.sums.value += error * error;
        }
        value.pass(&self.value, None, rows).backward(&mut self.value_gradients);
    }

    /// This block's part in the gradient of the actor after [`Block::improve`].
    #[must_use]
    pub fn actor_trace(&self) -> Trace<'_> {
        Trace {
            inputs: self.seen(),
            activations: &self.policy.activations,
            gradients: &self.actor_gradients,
            normalised: None,
        }
    }

    /// This block's part in the gradient of the value after [`Block::regress`].
    #[must_use]
    pub fn value_trace(&self) -> Trace<'_> {
        Trace {
            inputs: self.seen(),
            activations: &self.value,
            gradients: &self.value_gradients,
            normalised: None,
        }
    }
}
