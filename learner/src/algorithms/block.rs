//! One block of a batch's rows on its way through actor and critics: the passes that DDPG, TD3 and
//! SAC are made of.

use std::ops::Range;

use dmprl_shared::policy::{Activations, Head, HeadGradient, MlpShape, Policy, PolicyWorkspace};

use super::batch::States;
use super::{Batch, BatchShape};
use crate::update::BLOCK_ROWS;
use crate::update::layer_norm::Normalised;
use crate::update::pass::Gradients;
use crate::update::trained::{Lent, Trace, Trained};

/// A critic's buffers for one block.
#[derive(Debug)]
struct Buffers {
    activations: Activations,
    normalised: Option<Normalised>,
    gradients: Gradients,
}

impl Buffers {
    fn new(critic: &Trained, rows: usize) -> Self {
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

/// Sums over a block's rows, for the losses.
#[derive(Debug, Clone, Copy, Default)]
pub struct Sums {
    /// (Q - target)², all critics.
    pub squared_error: f32,
    /// Q of the batch's actions, first critic.
    pub q: f32,
    /// |Q| of the batch's actions, first critic.
    pub q_size: f32,
    /// Whatever the actor descends.
    pub actor: f32,
    /// log pi of the actor's own draws.
    pub log_density: f32,
}

/// The price of an action's change, and the batch that knows what was done before.
#[derive(Debug, Clone, Copy)]
pub struct ActionRate<'a> {
    /// Of a squared change, in units of Q.
    pub penalty: f32,
    /// Whose windows the policy acts on.
    pub batch: &'a Batch,
}

/// Some rows of the batch with all buffers of an update.
#[derive(Debug)]
pub struct Block {
    rows: Range<usize>,
    shape: BatchShape,
    critic_shape: MlpShape,
    /// Rows of the whole batch, over which losses are means.
    batch_rows: f32,
    /// What actor or target actor does.
    pub policy: PolicyWorkspace,
    actor_gradients: Gradients,
    critics: Vec<Buffers>,
    /// The critic's input with the policy's own actions, (rows, critic inputs).
    critic_inputs: Vec<f32>,
    /// What the critics regress on, (rows,).
    pub targets: Vec<f32>,
    /// log pi of the policy's draws, (rows,).
    pub log_densities: Vec<f32>,
    /// With respect to actions and end state, (rows, actions + end state), of one critic.
    input_gradient: Vec<f32>,
    /// With respect to u, then to the means before tanh, (rows, K A); all critics.
    pub actions_gradient: Vec<f32>,
    end_gradient: Vec<f32>,
    /// What the block adds to the losses.
    pub sums: Sums,
}

/// The blocks of a batch, for critics of one shape.
#[must_use]
pub fn blocks(policy: &Policy, shape: BatchShape, critics: &[Trained]) -> Vec<Block> {
    let block = |first: usize| {
        let rows = first..(first + BLOCK_ROWS).min(shape.rows);
        let count = rows.len();
        Block {
            rows,
            shape,
            // Without a critic nobody asks for its shape.
            critic_shape: critics.first().map_or(policy.shape(), |it| &it.shape).clone(),
            batch_rows: shape.rows as f32,
            policy: policy.workspace(count),
            actor_gradients: Gradients::new(policy.shape(), count),
            critics: critics.iter().map(|critic| Buffers::new(critic, count)).collect(),
            critic_inputs: vec![0.0; count * shape.critic_inputs()],
            targets: vec![0.0; count],
            log_densities: vec![0.0; count],
            input_gradient: vec![0.0; count * (shape.actions_len + shape.end_state_len)],
            actions_gradient: vec![0.0; count * shape.segment_actions_len],
            end_gradient: vec![0.0; count * shape.end_state_len],
            sums: Sums::default(),
        }
    };
    (0..shape.rows).step_by(BLOCK_ROWS).map(block).collect()
}

impl Block {
    /// This block's part of one of the batch's buffers.
    #[must_use]
    pub fn part<'a>(&self, buffer: &'a [f32]) -> &'a [f32] {
        let width = buffer.len() / self.shape.rows;
        &buffer[self.rows.start * width..self.rows.end * width]
    }

    fn rows_len(&self) -> usize {
        self.rows.len()
    }

    /// Rows of the whole batch.
    #[must_use]
    pub fn batch_rows(&self) -> f32 {
        self.batch_rows
    }

    /// u = pi(states), of an actor or its target.
    pub fn act(&mut self, policy: &Policy, actor: &Lent<'_>, states: States<'_>) {
        actor.forward(self.part(states.inputs), &mut self.policy.activations, None);
        policy.decode(self.part(states.observations), &mut self.policy);
    }

    /// Q(states, u) of the policy's own actions for each of the critics.
    pub fn judge(&mut self, policy: &Policy, critics: &[Lent<'_>], states: States<'_>) {
        self.assemble(policy, self.part(states.inputs));
        for (critic, buffers) in critics.iter().zip(&mut self.critics) {
            let Buffers { activations, normalised, .. } = buffers;
            critic.forward(&self.critic_inputs, activations, normalised.as_mut());
        }
    }

    /// Q of critic `index` after [`Block::judge`], (rows,).
    #[must_use]
    pub fn q(&self, index: usize) -> &[f32] {
        self.critics[index].activations.output(&self.critic_shape, self.rows_len())
    }

    /// targets = reward + bootstrap * value.
    pub fn set_targets(&mut self, batch: &Batch, value: impl Fn(&Self, usize) -> f32) {
        for row in 0..self.rows_len() {
            let at = self.rows.start + row;
            self.targets[row] = batch.rewards[at] + batch.bootstrap[at] * value(self, row);
        }
    }

    /// Passes of mean (Q - target)² for each critic, on the batch's own actions.
    pub fn regress(&mut self, critics: &[Lent<'_>], batch: &Batch) {
        let inputs = self.part(&batch.critic_inputs);
        let rows = self.rows_len();
        self.sums = Sums::default();
        for (index, (critic, buffers)) in critics.iter().zip(&mut self.critics).enumerate() {
            let Buffers { activations, normalised, gradients } = buffers;
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
            critic.pass(activations, normalised.as_ref(), rows).backward(gradients);
        }
    }

    /// After [`Block::judge`]: sums the gradient of `weight(row, critic) Q_critic` with respect to
    /// actions and end state over the critics; none of the critics' own parameters, which the actor
    /// does not need.
    pub fn actions_gradient(
        &mut self,
        critics: &[Lent<'_>],
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
            let Buffers { activations, normalised, gradients } = &mut self.critics[index];
            let pass = critic.pass(activations, normalised.as_ref(), rows);
            pass.backward(gradients);
            let first = self.shape.observation_len;
            pass.input_gradient(gradients, first, &mut self.input_gradient);
            self.add_input_gradient();
        }
    }

    /// Passes of -mean Q of the one critic, after [`Block::act`] and [`Block::judge`].
    pub fn ascend_q(
        &mut self,
        policy: &Policy,
        actor: &Lent<'_>,
        critic: &[Lent<'_>; 1],
        rate: ActionRate<'_>,
    ) {
        self.sums = Sums { actor: -self.q(0).iter().sum::<f32>(), ..Sums::default() };
        let weight = -1.0 / self.batch_rows;
        self.actions_gradient(critic, |_, _, _| weight);
        self.unsquash();
        self.penalise(policy, rate);
        self.log_stds_backward(policy, |_, _, _| 0.0);
        self.act_backward(policy, actor);
    }

    /// Passes of mean (pi(s) - u)², `actions` (B, K A) being the u to imitate; leaves the sum of
    /// squares in `sums.actor`.
    pub fn imitate(
        &mut self,
        policy: &Policy,
        actor: &Lent<'_>,
        states: States<'_>,
        actions: &[f32],
    ) {
        self.act(policy, actor, states);
        let factor = 2.0 / actions.len() as f32;
        let wanted = &actions[self.rows.start * self.shape.segment_actions_len..];
        self.sums = Sums::default();
        let errors = self.policy.actions.iter().zip(wanted).map(|(action, wanted)| action - wanted);
        for (gradient, error) in self.actions_gradient.iter_mut().zip(errors) {
            *gradient = factor * error;
            self.sums.actor += error * error;
        }
        self.end_gradient.fill(0.0);
        self.unsquash();
        self.log_stds_backward(policy, |_, _, _| 0.0);
        self.act_backward(policy, actor);
    }

    fn add_input_gradient(&mut self) {
        let BatchShape { actions_len, end_state_len, segment_actions_len, .. } = self.shape;
        let width = actions_len + end_state_len;
        for (row, input) in self.input_gradient.chunks_exact(width).enumerate() {
            // Actions that the critic does not see have no gradient.
            let actions = &mut self.actions_gradient[row * segment_actions_len..][..actions_len];
            actions.iter_mut().zip(input).for_each(|(sum, gradient)| *sum += gradient);
            let end = &mut self.end_gradient[row * end_state_len..][..end_state_len];
            end.iter_mut().zip(&input[actions_len..]).for_each(|(sum, gradient)| *sum += gradient);
        }
    }

    /// From the gradient with respect to u, as [`Block::actions_gradient`] left it, to the one with
    /// respect to the means before their tanh.
    pub fn unsquash(&mut self) {
        for (gradient, action) in self.actions_gradient.iter_mut().zip(&self.policy.actions) {
            *gradient *= 1.0 - action * action;
        }
    }

    /// Adds what the changes of tanh(means) cost to `sums.actor`, and its gradient to that with
    /// respect to the means, as [`Block::unsquash`] left it. Leaves tanh(means) as the actions.
    pub fn penalise(&mut self, policy: &Policy, ActionRate { penalty, batch }: ActionRate<'_>) {
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

    /// Gradient to the raw log-stds, which `log_std(block, row, action)` gives, if the policy has
    /// any; before [`Block::act_backward`].
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

    /// Passes of the actor, from the gradient with respect to the means in `actions_gradient`, and
    /// what [`Block::log_stds_backward`] left.
    pub fn act_backward(&mut self, policy: &Policy, actor: &Lent<'_>) {
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
        let pass = actor.pass(&self.policy.activations, None, rows);
        pass.backward(&mut self.actor_gradients);
    }

    /// This block's part in the gradient of critic `index` after [`Block::regress`].
    #[must_use]
    pub fn critic_trace<'a>(&'a self, index: usize, batch: &'a Batch) -> Trace<'a> {
        let Buffers { activations, normalised, gradients } = &self.critics[index];
        let inputs = self.part(&batch.critic_inputs);
        Trace { inputs, activations, normalised: normalised.as_ref(), gradients }
    }

    /// This block's part in the gradient of the actor after [`Block::act_backward`].
    #[must_use]
    pub fn actor_trace<'a>(&'a self, batch: &'a Batch) -> Trace<'a> {
        self.trace(&batch.inputs)
    }

    /// The same for an actor that has seen `inputs`, (B, O).
    #[must_use]
    pub fn trace<'a>(&'a self, inputs: &'a [f32]) -> Trace<'a> {
        Trace {
            inputs: self.part(inputs),
            activations: &self.policy.activations,
            normalised: None,
            gradients: &self.actor_gradients,
        }
    }

    /// Builds the critic's input from what networks see of the states and the actions that
    /// `policy` holds.
    fn assemble(&mut self, policy: &Policy, inputs: &[f32]) {
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

/// The sums of all blocks, in their order.
#[must_use]
pub fn total(blocks: &[Block]) -> Sums {
    blocks.iter().map(|block| block.sums).fold(Sums::default(), |a, b| Sums {
        squared_error: a.squared_error + b.squared_error,
        q: a.q + b.q,
        q_size: a.q_size + b.q_size,
        actor: a.actor + b.actor,
        log_density: a.log_density + b.log_density,
    })
}
