//! A shard of a batch, with the forward and backward passes of DDPG, TD3 and SAC.

use std::ops::Range;

use dmprl_shared::policy::{Activations, Head, HeadGradient, MlpShape, Policy, PolicyWorkspace};

use super::batch::States;
use super::{Batch, BatchShape};
use crate::update::SHARD_ROWS;
use crate::update::backward_pass::Gradients;
use crate::update::layer_norm::Normalised;
use crate::update::network::{NetworkView, PassRecord, TrainableNetwork};

/// A critic's buffers for one shard.
#[derive(Debug)]
struct CriticBuffers {
    activations: Activations,
    normalised: Option<Normalised>,
    gradients: Gradients,
}

impl CriticBuffers {
    fn new(critic: &TrainableNetwork, rows: usize) -> Self {
        let shape = &critic.shape;
        let activations = Activations::new(shape, rows);
        match critic.layer_norm {
            None => Self { activations, normalised: None, gradients: Gradients::new(shape, rows) },
            Some(_) => Self {
                activations,
                normalised: Some(Normalised::new(shape, rows)),
                gradients: Gradients::with_layer_norm(shape, rows),
            },
        }
    }
}

/// Terms of the losses, summed over a shard's rows.
#[derive(Debug, Clone, Copy, Default)]
pub struct LossSums {
    /// (Q - target)² of all critics.
    pub squared_error: f32,
    /// Q of the batch's actions, from the first critic.
    pub q: f32,
    /// |Q| of the batch's actions, from the first critic.
    pub q_size: f32,
    /// The actor's loss.
    pub actor: f32,
    /// log pi of the actions that the actor drew.
    pub log_density: f32,
}

/// The penalty on action changes, with the batch that has the previous actions.
#[derive(Debug, Clone, Copy)]
pub struct ActionRate<'a> {
    /// Weight of a squared change, in units of Q.
    pub penalty: f32,
    /// The batch that the policy acts on.
    pub batch: &'a Batch,
}

/// Some rows of a batch, with all buffers of an update.
#[derive(Debug)]
pub struct BatchShard {
    rows: Range<usize>,
    shape: BatchShape,
    critic_shape: MlpShape,
    /// Rows of the whole batch, over which the losses are averaged.
    batch_rows: f32,
    /// Actions of actor or target actor.
    pub policy: PolicyWorkspace,
    actor_gradients: Gradients,
    critics: Vec<CriticBuffers>,
    /// Critic inputs with the policy's own actions, (rows, critic inputs).
    critic_inputs: Vec<f32>,
    /// Targets of the critics, (rows,).
    pub targets: Vec<f32>,
    /// log pi of the actions that the policy drew, (rows,).
    pub log_densities: Vec<f32>,
    /// Gradient of one critic with respect to actions and end state, (rows, actions + end state).
    input_gradient: Vec<f32>,
    /// Gradient with respect to u, later to the means before tanh, (rows, K A), from all critics.
    pub actions_gradient: Vec<f32>,
    /// Gradient with respect to the end state, (rows, 2A) or empty, from all critics.
    end_gradient: Vec<f32>,
    /// Terms of the losses.
    pub sums: LossSums,
}

/// Cuts a batch into shards, with buffers for critics of one shape.
#[must_use]
pub fn shards(policy: &Policy, shape: BatchShape, critics: &[TrainableNetwork]) -> Vec<BatchShard> {
    let shard = |first: usize| {
        let rows = first..(first + SHARD_ROWS).min(shape.rows);
        let count = rows.len();
        BatchShard {
            rows,
            shape,
            // Unused without a critic.
            critic_shape: critics.first().map_or(policy.shape(), |it| &it.shape).clone(),
            batch_rows: shape.rows as f32,
            policy: policy.workspace(count),
            actor_gradients: Gradients::new(policy.shape(), count),
            critics: critics.iter().map(|critic| CriticBuffers::new(critic, count)).collect(),
            critic_inputs: vec![0.0; count * shape.critic_inputs()],
            targets: vec![0.0; count],
            log_densities: vec![0.0; count],
            input_gradient: vec![0.0; count * (shape.actions_len + shape.end_state_len)],
            actions_gradient: vec![0.0; count * shape.segment_actions_len],
            end_gradient: vec![0.0; count * shape.end_state_len],
            sums: LossSums::default(),
        }
    };
    (0..shape.rows).step_by(SHARD_ROWS).map(shard).collect()
}

impl BatchShard {
    /// Returns this shard's part of one of the batch's buffers.
    #[must_use]
    pub fn part<'a>(&self, buffer: &'a [f32]) -> &'a [f32] {
        let width = buffer.len() / self.shape.rows;
        &buffer[self.rows.start * width..self.rows.end * width]
    }

    fn rows_len(&self) -> usize {
        self.rows.len()
    }

    /// Returns the number of rows of the whole batch.
    #[must_use]
    pub fn batch_rows(&self) -> f32 {
        self.batch_rows
    }

    /// Computes u = pi(states) of an actor or its target.
    pub fn act(&mut self, policy: &Policy, actor: &NetworkView<'_>, states: States<'_>) {
        actor.forward(self.part(states.inputs), &mut self.policy.activations, None);
        policy.decode(self.part(states.observations), &mut self.policy);
    }

    /// Computes Q(states, u) of the policy's own actions with each critic.
    pub fn evaluate_critics(
        &mut self,
        policy: &Policy,
        critics: &[NetworkView<'_>],
        states: States<'_>,
    ) {
        self.assemble_critic_inputs(policy, self.part(states.inputs));
        for (critic, buffers) in critics.iter().zip(&mut self.critics) {
            let CriticBuffers { activations, normalised, .. } = buffers;
            critic.forward(&self.critic_inputs, activations, normalised.as_mut());
        }
    }

    /// Returns Q of critic `index`, (rows,). Call it after [`BatchShard::evaluate_critics`].
    #[must_use]
    pub fn q(&self, index: usize) -> &[f32] {
        self.critics[index].activations.output(&self.critic_shape, self.rows_len())
    }

    /// Sets targets = reward + bootstrap * value, clipped to the batch's range.
    pub fn set_targets(&mut self, batch: &Batch, value: impl Fn(&Self, usize) -> f32) {
        let [low, high] = batch.target_range;
        for row in 0..self.rows_len() {
            let at = self.rows.start + row;
            let target = batch.rewards[at] + batch.bootstrap[at] * value(self, row);
            self.targets[row] = target.clamp(low, high);
        }
    }

    /// Runs the forward and backward passes of each critic's loss mean (Q - target)², on the
    /// batch's own actions.
    pub fn critic_backward(&mut self, critics: &[NetworkView<'_>], batch: &Batch) {
        let inputs = self.part(&batch.critic_inputs);
        let rows = self.rows_len();
        self.sums = LossSums::default();
        for (index, (critic, buffers)) in critics.iter().zip(&mut self.critics).enumerate() {
            let CriticBuffers { activations, normalised, gradients } = buffers;
            critic.forward(inputs, activations, normalised.as_mut());
            let q = activations.output(&self.critic_shape, rows);
            let out = gradients.output_mut(&self.critic_shape, rows);
            for ((out, q), target) in out.iter_mut().zip(q).zip(&self.targets) {
                let error = q - target;
                *out = 2.0 * error / self.batch_rows;
                self.sums.squared_error += error * error;
                if index == 0 {
                    self.sums.q += *q;
                    self.sums.q_size += q.abs();
                }
            }
            critic.backward_pass(activations, normalised.as_ref(), rows).run(gradients);
        }
    }

    /// Sums the gradients of `weight(shard, row, critic) * Q_critic` with respect to actions and
    /// end state over the critics. Call it after [`BatchShard::evaluate_critics`]. It skips the
    /// gradients of the critics' parameters, which the actor does not need.
    pub fn actions_gradient(
        &mut self,
        critics: &[NetworkView<'_>],
        weight: impl Fn(&Self, usize, usize) -> f32,
    ) {
        self.actions_gradient.fill(0.0);
        self.end_gradient.fill(0.0);
        let rows = self.rows_len();
        for (index, critic) in critics.iter().enumerate() {
            for row in 0..rows {
                let weight = weight(self, row, index);
                self.critics[index].gradients.output_mut(&self.critic_shape, rows)[row] = weight;
            }
            let CriticBuffers { activations, normalised, gradients } = &mut self.critics[index];
            let pass = critic.backward_pass(activations, normalised.as_ref(), rows);
            pass.run(gradients);
            let first = self.shape.observation_len;
            pass.input_gradient(gradients, first, &mut self.input_gradient);
            self.add_input_gradient();
        }
    }

    /// Runs the backward passes of the loss -mean Q of one critic, plus the penalty on action
    /// changes. Call it after [`BatchShard::act`] and [`BatchShard::evaluate_critics`].
    pub fn deterministic_policy_gradient(
        &mut self,
        policy: &Policy,
        actor: &NetworkView<'_>,
        critic: &[NetworkView<'_>; 1],
        rate: ActionRate<'_>,
    ) {
        self.sums = LossSums { actor: -self.q(0).iter().sum::<f32>(), ..LossSums::default() };
        let weight = -1.0 / self.batch_rows;
        self.actions_gradient(critic, |_, _, _| weight);
        self.unsquash();
        self.penalise(policy, rate);
        self.log_stds_backward(policy, |_, _, _| 0.0);
        self.actor_backward(policy, actor);
    }

    /// Runs the passes of the loss mean (pi(s) - u)², where u, (B, K A), are the `actions` to
    /// imitate. Sets `sums.actor` to the sum of squares.
    pub fn imitation_backward(
        &mut self,
        policy: &Policy,
        actor: &NetworkView<'_>,
        states: States<'_>,
        actions: &[f32],
    ) {
        self.act(policy, actor, states);
        let factor = 2.0 / actions.len() as f32;
        let wanted = &actions[self.rows.start * self.shape.segment_actions_len..];
        self.sums = LossSums::default();
        let errors = self.policy.actions.iter().zip(wanted).map(|(action, wanted)| action - wanted);
        for (gradient, error) in self.actions_gradient.iter_mut().zip(errors) {
            *gradient = factor * error;
            self.sums.actor += error * error;
        }
        self.end_gradient.fill(0.0);
        self.unsquash();
        self.log_stds_backward(policy, |_, _, _| 0.0);
        self.actor_backward(policy, actor);
    }

    fn add_input_gradient(&mut self) {
        let BatchShape { actions_len, end_state_len, segment_actions_len, .. } = self.shape;
        let width = actions_len + end_state_len;
        for (row, input) in self.input_gradient.chunks_exact(width).enumerate() {
            // Actions that the critic does not see have a gradient of zero.
            let actions = &mut self.actions_gradient[row * segment_actions_len..][..actions_len];
            actions.iter_mut().zip(input).for_each(|(sum, gradient)| *sum += gradient);
            let end = &mut self.end_gradient[row * end_state_len..][..end_state_len];
            end.iter_mut().zip(&input[actions_len..]).for_each(|(sum, gradient)| *sum += gradient);
        }
    }

    /// Turns the gradient with respect to u, from [`BatchShard::actions_gradient`], into the
    /// gradient with respect to the means before their tanh.
    pub fn unsquash(&mut self) {
        for (gradient, action) in self.actions_gradient.iter_mut().zip(&self.policy.actions) {
            *gradient *= 1.0 - action * action;
        }
    }

    /// Adds the penalty on changes of tanh(means) to the actor's loss and its gradient. Call it
    /// after [`BatchShard::unsquash`]. Sets the actions to tanh(means).
    pub fn penalise(&mut self, policy: &Policy, rate: ActionRate<'_>) {
        let ActionRate { penalty, batch } = rate;
        if penalty == 0.0 {
            return;
        }
        let BatchShape { action_len: dims, segment_actions_len: len, .. } = self.shape;
        policy.bound_means(&mut self.policy, self.rows.len() * len);
        let factor = 2.0 * penalty / self.batch_rows;
        for row in 0..self.rows_len() {
            let at = self.rows.start + row;
            let actions = &self.policy.actions[row * len..(row + 1) * len];
            let gradient = &mut self.actions_gradient[row * len..(row + 1) * len];
            let slope = |i: usize| factor * (1.0 - actions[i] * actions[i]);
            let previous = &batch.previous_actions[at * dims..(at + 1) * dims];
            for (d, previous) in previous.iter().enumerate() {
                let change = batch.has_previous[at] * (actions[d] - previous);
                gradient[d] += slope(d) * change;
                self.sums.actor += penalty * change * change;
            }
            for i in dims..len {
                let change = actions[i] - actions[i - dims];
                gradient[i] += slope(i) * change;
                gradient[i - dims] -= slope(i - dims) * change;
                self.sums.actor += penalty * change * change;
            }
        }
    }

    /// Sets the gradient with respect to the raw log-stds to `log_std(shard, row, action)`, if the
    /// policy has any. Call it before [`BatchShard::actor_backward`].
    pub fn log_stds_backward(
        &mut self,
        policy: &Policy,
        log_std: impl Fn(&Self, usize, usize) -> f32,
    ) {
        let rows = self.rows_len();
        for (index, column) in policy.log_stds().into_iter().flatten().enumerate() {
            for row in 0..rows {
                let at = row * policy.shape().outputs() + column;
                let gradient = log_std(self, row, index);
                self.actor_gradients.output_mut(policy.shape(), rows)[at] = gradient;
            }
        }
    }

    /// Runs the actor's backward pass from the gradient with respect to the means, in
    /// `actions_gradient`, and to the log-stds.
    pub fn actor_backward(&mut self, policy: &Policy, actor: &NetworkView<'_>) {
        let rows = self.rows_len();
        let stride = policy.shape().outputs();
        let outputs = self.actor_gradients.output_mut(policy.shape(), rows);
        match (policy.head(), &mut self.policy.dmp) {
            (Head::Dmp(head), Some(dmp)) => {
                let gradient =
                    HeadGradient { means: &self.actions_gradient, end_state: &self.end_gradient };
                head.backward(dmp, gradient, outputs, stride);
            }
            _ => {
                let dims = self.shape.segment_actions_len;
                let rows = outputs.chunks_exact_mut(stride);
                for (out, gradient) in rows.zip(self.actions_gradient.chunks_exact(dims)) {
                    out[..dims].copy_from_slice(gradient);
                }
            }
        }
        let pass = actor.backward_pass(&self.policy.activations, None, rows);
        pass.run(&mut self.actor_gradients);
    }

    /// Returns the record for critic `index`. Call it after [`BatchShard::critic_backward`].
    #[must_use]
    pub fn critic_record<'a>(&'a self, index: usize, batch: &'a Batch) -> PassRecord<'a> {
        let CriticBuffers { activations, normalised, gradients } = &self.critics[index];
        let inputs = self.part(&batch.critic_inputs);
        PassRecord { inputs, activations, normalised: normalised.as_ref(), gradients }
    }

    /// Returns the record for the actor. Call it after [`BatchShard::actor_backward`].
    #[must_use]
    pub fn actor_record<'a>(&'a self, batch: &'a Batch) -> PassRecord<'a> {
        self.record(&batch.inputs)
    }

    /// Returns the record for an actor whose network inputs were `inputs`, (B, O).
    #[must_use]
    pub fn record<'a>(&'a self, inputs: &'a [f32]) -> PassRecord<'a> {
        PassRecord {
            inputs: self.part(inputs),
            activations: &self.policy.activations,
            normalised: None,
            gradients: &self.actor_gradients,
        }
    }

    /// Builds the critic inputs from the network inputs of the states and the policy's actions.
    fn assemble_critic_inputs(&mut self, policy: &Policy, inputs: &[f32]) {
        let BatchShape { observation_len, actions_len, segment_actions_len, .. } = self.shape;
        let width = self.shape.critic_inputs();
        for (row, input) in self.critic_inputs.chunks_exact_mut(width).enumerate() {
            let state = &inputs[row * observation_len..(row + 1) * observation_len];
            let actions = &self.policy.actions[row * segment_actions_len..];
            input[..observation_len].copy_from_slice(state);
            input[observation_len..observation_len + actions_len]
                .copy_from_slice(&actions[..actions_len]);
        }
        if self.shape.end_state_len > 0
            && let (Head::Dmp(head), Some(dmp)) = (policy.head(), &self.policy.dmp)
        {
            let from = observation_len + actions_len;
            head.end_states(dmp, &mut self.critic_inputs[from..], width);
        }
    }
}

/// Adds the sums of all shards, in their order.
#[must_use]
pub fn total(shards: &[BatchShard]) -> LossSums {
    shards.iter().map(|shard| shard.sums).fold(LossSums::default(), |a, b| LossSums {
        squared_error: a.squared_error + b.squared_error,
        q: a.q + b.q,
        q_size: a.q_size + b.q_size,
        actor: a.actor + b.actor,
        log_density: a.log_density + b.log_density,
    })
}
