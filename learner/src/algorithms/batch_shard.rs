//! A shard of a batch, with the forward and backward passes of DDPG, TD3 and SAC.

use std::ops::Range;

use dmprl_shared::policy::{Activations, Head, HeadGradient, MlpShape, Policy, PolicyWorkspace};

use super::action_penalties::{ActionPenalties, ActionRow};
use super::batch::States;
use super::outcome::OutcomeBuffers;
use super::{Batch, BatchShape};
use crate::update::SHARD_ROWS;
use crate::update::backward_pass::Gradients;
use crate::update::layer_norm::Normalised;
use crate::update::network::{NetworkView, PassRecord, TrainableNetwork};
use crate::update::thread_pool::ThreadPool;

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
    /// Critic inputs with the policy's own actions, (rows, critic width).
    critic_inputs: Vec<f32>,
    outcome: Option<OutcomeBuffers>,
    /// Critic inputs with the batch's actions and the outcome model's features, (rows, critic
    /// width), or empty without a model.
    batch_inputs: Vec<f32>,
    /// Targets of the critics, (rows,).
    pub targets: Vec<f32>,
    /// log pi of the actions that the policy drew, (rows,).
    pub log_densities: Vec<f32>,
    /// Gradient of one critic with respect to its inputs after the observation.
    input_gradient: Vec<f32>,
    /// Gradient with respect to u, later to the means before tanh, (rows, K A), from all critics.
    pub actions_gradient: Vec<f32>,
    /// Gradient with respect to the end state, (rows, 2A) or empty, from all critics.
    end_gradient: Vec<f32>,
    /// Terms of the losses.
    pub sums: LossSums,
}

/// Cuts a batch into shards, with buffers for critics of one shape, and the outcome model that they
/// see.
#[must_use]
pub fn shards(
    policy: &Policy,
    shape: BatchShape,
    critics: &[TrainableNetwork],
    outcome_model: Option<&TrainableNetwork>,
) -> Vec<BatchShard> {
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
            critic_inputs: vec![0.0; count * shape.critic_width()],
            outcome: outcome_model.and_then(|model| OutcomeBuffers::new(shape, model, count)),
            batch_inputs: match outcome_model {
                Some(_) => vec![0.0; count * shape.critic_width()],
                None => Vec::new(),
            },
            targets: vec![0.0; count],
            log_densities: vec![0.0; count],
            input_gradient: vec![0.0; count * (shape.critic_width() - shape.observation_len)],
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
        part(&self.rows, self.shape.rows, buffer)
    }

    /// Returns the critic inputs with the batch's own actions.
    fn batch_inputs<'a>(&'a self, batch: &'a Batch) -> &'a [f32] {
        match self.outcome {
            Some(_) => &self.batch_inputs,
            None => self.part(&batch.critic_inputs),
        }
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

    /// Predicts the outcomes of the batch's own actions, for [`BatchShard::critic_backward`], and
    /// runs the model's backward pass.
    pub fn outcome_backward(&mut self, model: &NetworkView<'_>, batch: &Batch) {
        let Some(outcome) = &mut self.outcome else { return };
        let part = |buffer| part(&self.rows, self.shape.rows, buffer);
        let (narrow, width) = (self.shape.critic_inputs(), self.shape.critic_width());
        let rows = part(&batch.critic_inputs).chunks_exact(narrow);
        for (row, out) in rows.zip(self.batch_inputs.chunks_exact_mut(width)) {
            out[..narrow].copy_from_slice(row);
        }
        outcome.predict(model, part(&batch.observations), &mut self.batch_inputs, width);
        outcome.loss_backward(model, part(&batch.motion), self.batch_rows);
    }

    /// Returns the record for the outcome model. Call it after [`BatchShard::outcome_backward`].
    ///
    /// # Panics
    /// Without a model.
    #[must_use]
    pub fn outcome_record(&self) -> PassRecord<'_> {
        self.outcome.as_ref().expect("an outcome model").record()
    }

    /// Computes Q(states, u) of the policy's own actions with each critic. They see the features of
    /// the outcome model, if there is one.
    pub fn evaluate_critics(
        &mut self,
        policy: &Policy,
        critics: &[NetworkView<'_>],
        outcome_model: Option<&NetworkView<'_>>,
        states: States<'_>,
    ) {
        self.assemble_critic_inputs(policy, self.part(states.inputs));
        if let (Some(outcome), Some(model)) = (&mut self.outcome, outcome_model) {
            let observations = part(&self.rows, self.shape.rows, states.observations);
            let width = self.shape.critic_width();
            outcome.predict(model, observations, &mut self.critic_inputs, width);
        }
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
        let rows = self.rows_len();
        let inputs = match self.outcome {
            Some(_) => &self.batch_inputs,
            None => part(&self.rows, self.shape.rows, &batch.critic_inputs),
        };
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
        outcome_model: Option<&NetworkView<'_>>,
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
        if let (Some(outcome), Some(model)) = (&mut self.outcome, outcome_model) {
            let through = outcome.actions_gradient(model);
            let sums = self.actions_gradient.iter_mut().zip(through);
            sums.for_each(|(sum, gradient)| *sum += gradient);
        }
    }

    /// Runs the backward passes of the loss -mean Q of one critic, plus the penalties on action
    /// changes. Call it after [`BatchShard::act`] and [`BatchShard::evaluate_critics`].
    pub fn deterministic_policy_gradient(
        &mut self,
        policy: &Policy,
        actor: &NetworkView<'_>,
        critic: &[NetworkView<'_>; 1],
        outcome_model: Option<&NetworkView<'_>>,
        penalties: ActionPenalties,
        batch: &Batch,
    ) {
        self.sums = LossSums { actor: -self.q(0).iter().sum::<f32>(), ..LossSums::default() };
        let weight = -1.0 / self.batch_rows;
        self.actions_gradient(critic, outcome_model, |_, _, _| weight);
        self.unsquash();
        self.penalise(policy, penalties, batch);
        self.log_stds_backward(policy, |_, _, _| 0.0);
        self.actor_backward(policy, actor, penalties);
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
        self.actor_backward(policy, actor, ActionPenalties::default());
    }

    fn add_input_gradient(&mut self) {
        let BatchShape { actions_len, end_state_len, segment_actions_len, .. } = self.shape;
        let width = self.shape.critic_width() - self.shape.observation_len;
        for (row, input) in self.input_gradient.chunks_exact(width).enumerate() {
            // Actions that the critic does not see have a gradient of zero.
            let actions = &mut self.actions_gradient[row * segment_actions_len..][..actions_len];
            actions.iter_mut().zip(input).for_each(|(sum, gradient)| *sum += gradient);
            let end = &mut self.end_gradient[row * end_state_len..][..end_state_len];
            end.iter_mut().zip(&input[actions_len..]).for_each(|(sum, gradient)| *sum += gradient);
            if let Some(outcome) = &mut self.outcome {
                outcome.add_features_gradient(row, &input[actions_len + end_state_len..]);
            }
        }
    }

    /// Turns the gradient with respect to u, from [`BatchShard::actions_gradient`], into the
    /// gradient with respect to the means before their tanh.
    pub fn unsquash(&mut self) {
        for (gradient, action) in self.actions_gradient.iter_mut().zip(&self.policy.actions) {
            *gradient *= 1.0 - action * action;
        }
    }

    /// Adds the penalties on the actions tanh(means) to the actor's loss and its gradient. Call it
    /// after [`BatchShard::unsquash`]. Sets the actions to tanh(means).
    pub fn penalise(&mut self, policy: &Policy, penalties: ActionPenalties, batch: &Batch) {
        if penalties.ignore_actions() {
            return;
        }
        let BatchShape { action_len: dims, segment_actions_len: len, .. } = self.shape;
        policy.bound_means(&mut self.policy, self.rows.len() * len);
        for row in 0..self.rows_len() {
            let at = self.rows.start + row;
            let actions = &self.policy.actions[row * len..(row + 1) * len];
            let gradient = &mut self.actions_gradient[row * len..(row + 1) * len];
            let row = ActionRow {
                actions,
                previous: &batch.previous_actions[2 * at * dims..2 * (at + 1) * dims],
                has_previous: [batch.has_previous[2 * at], batch.has_previous[2 * at + 1]],
                imitated: batch.imitated(self.shape, at),
            };
            let slope = |i: usize| (1.0 - actions[i] * actions[i]) / self.batch_rows;
            self.sums.actor += penalties.add(row, gradient, slope);
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
    /// `actions_gradient`, and to the log-stds. Adds the penalty on saturation to the loss and its
    /// gradient.
    pub fn actor_backward(
        &mut self,
        policy: &Policy,
        actor: &NetworkView<'_>,
        penalties: ActionPenalties,
    ) {
        let rows = self.rows_len();
        if policy.squashes() {
            let (means, gradient) = (&self.policy.means, &mut self.actions_gradient);
            self.sums.actor += penalties.add_saturation(means, gradient, self.batch_rows);
        }
        let stride = policy.shape().outputs();
        let outputs = self.actor_gradients.output_mut(policy.shape(), rows);
        match (policy.head(), &mut self.policy.dmp) {
            (Head::Dmp(head), Some(dmp)) => {
                let gradient =
                    HeadGradient { means: &self.actions_gradient, end_state: &self.end_gradient };
                head.backward(dmp, gradient, outputs, stride);
                let values = self.policy.activations.output(policy.shape(), rows);
                let pairs = values.chunks_exact(stride).zip(outputs.chunks_exact_mut(stride));
                for (values, gradient) in pairs {
                    for range in head.squashed_outputs() {
                        let (values, gradient) = (&values[range.clone()], &mut gradient[range]);
                        self.sums.actor +=
                            penalties.add_saturation(values, gradient, self.batch_rows);
                    }
                }
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
        let inputs = self.batch_inputs(batch);
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
        let width = self.shape.critic_width();
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

/// Returns the part of a buffer of `batch_rows` rows that belongs to some of them.
fn part<'a>(rows: &Range<usize>, batch_rows: usize, buffer: &'a [f32]) -> &'a [f32] {
    let width = buffer.len() / batch_rows;
    &buffer[rows.start * width..rows.end * width]
}

/// Does an optimiser step of the outcome model, if there is one, on the batch's own actions. Call
/// it before the critics' step, which uses the predictions.
pub fn outcome_step(
    model: &mut Option<TrainableNetwork>,
    shards: &mut [BatchShard],
    batch: &Batch,
    pool: &mut ThreadPool,
) {
    let Some(model) = model else { return };
    let view = model.view();
    pool.for_each(shards, |shard| shard.outcome_backward(&view, batch));
    drop(view);
    model.adam_step(pool, shards, BatchShard::outcome_record, None);
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
