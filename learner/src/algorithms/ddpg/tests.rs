//! The hand-derived gradients against candle's automatic differentiation of the same losses,
//! written out as a graph with none of our kernels.

use candle_core::{D, Device, Result, Tensor, Var};
use dmprl_shared::config::{ExperimentConfig, ForcingScaling, Layers};
use dmprl_shared::dmp::{Dmp, SegmentMap};
use rand::RngExt;

use super::*;
use crate::learner::tests::spec;

struct Case {
    config: ExperimentConfig,
    policy: Policy,
    ddpg: Ddpg,
    batch: Batch,
}

fn case(keys: &[(&str, &str)]) -> Case {
    let mut layers = Layers::new();
    let common = [
        ("policy.hidden", "[24, 16]"),
        ("algorithm.critic_hidden", "[20, 12]"),
        ("algorithm.batch_size", "16"),
        ("task.start_sources", "[{cos=0, sin=1, velocity=2}, {index=3, velocity=2, scale=-1.0}]"),
    ];
    for (key, value) in common.iter().chain(keys) {
        layers.set("test", key, value).unwrap();
    }
    let config = layers.finish().unwrap();
    let policy = Policy::new(&config, &spec()).unwrap();
    let mut ddpg = Ddpg::new(&config, &policy).unwrap();
    // Targets that differ from their networks, so that mixing them up shows.
    let mut random = seeds::stream(3, "test", 0);
    for trained in [&mut ddpg.actor, &mut ddpg.critic] {
        let disturb = |values: &mut [f32]| {
            values.iter_mut().for_each(|value| *value += random.random_range(-0.05..0.05));
        };
        trained.target.update(disturb).unwrap();
    }
    let mut batch = Batch::new(ddpg.batch_shape());
    let mut fill = |values: &mut [f32]| {
        values.iter_mut().for_each(|value| *value = random.random_range(-1.0..1.0));
    };
    fill(&mut batch.observations);
    fill(&mut batch.critic_inputs);
    fill(&mut batch.rewards);
    fill(&mut batch.bootstrap);
    fill(&mut batch.next_observations);
    Case { config, policy, ddpg, batch }
}

/// A multilayer perceptron over a flat variable, as a graph.
fn network(shape: &MlpShape, flat: &Tensor, inputs: &Tensor) -> Result<Tensor> {
    let mut x = inputs.clone();
    for (index, layer) in shape.layers().iter().enumerate() {
        let weights = flat.narrow(0, layer.weights.start, layer.weights.len())?;
        let weights = weights.reshape((layer.outputs, layer.inputs))?;
        let bias = flat.narrow(0, layer.bias.start, layer.bias.len())?;
        x = x.matmul(&weights.t()?)?.broadcast_add(&bias)?;
        if index + 1 < shape.layers().len() {
            x = x.relu()?;
        }
    }
    Ok(x)
}

impl Case {
    fn tensor(&self, values: &[f32], width: usize) -> Tensor {
        Tensor::from_slice(values, (values.len() / width, width), &Device::Cpu).unwrap()
    }

    /// Actions and end state, (B, K A + 2A or 0), of the policy as a graph.
    fn policy_graph(&self, flat: &Tensor, observations: &[f32]) -> Result<Tensor> {
        let o = self.policy.layout().observation_len;
        let outputs = network(self.policy.shape(), flat, &self.tensor(observations, o))?;
        match self.policy.head() {
            Head::Mlp => outputs.tanh(),
            Head::Dmp(_) => self.dmp_graph(&outputs, observations),
        }
    }

    fn dmp_graph(&self, outputs: &Tensor, observations: &[f32]) -> Result<Tensor> {
        let (n, k) = (self.config.dmp.basis_count, self.config.policy.segment_steps);
        let (o, dims) = (self.policy.layout().observation_len, 2);
        let rows = observations.len() / o;
        let dmp = Dmp::new(&self.config.dmp, k).unwrap();
        let weight_scale = self.config.policy.weight_range * dmp.omega() * dmp.omega();
        let map = SegmentMap::new(&dmp, weight_scale);
        let matrix = Tensor::from_slice(map.matrix(), (3 * k, 3 + n), &Device::Cpu)?;
        let start = starts(self, observations);
        let start = Tensor::from_vec(start, (rows * dims, 2), &Device::Cpu)?;
        let cells = outputs.reshape((rows * dims, n + 5))?;
        let goal = (cells.narrow(1, 0, 1)?.tanh()? * self.config.policy.goal_range)?;
        let mut weights = cells.narrow(1, 1, n)?.tanh()?;
        if self.config.dmp.forcing_scaling == ForcingScaling::Goal {
            weights = weights.broadcast_mul(&(&goal - start.narrow(1, 0, 1)?)?)?;
        }
        let centre = Tensor::new(&[1.0_f32, 0.0, 0.0, 0.0], &Device::Cpu)?;
        let rho = (cells.narrow(1, n + 1, 4)?.tanh()? * self.config.policy.rho_range)?;
        let rho = rho.broadcast_add(&centre)?;
        let inputs = Tensor::cat(&[&start, &goal, &weights], 1)?;
        let samples = inputs.matmul(&matrix.t()?)?;
        let mut u = rho.narrow(1, 3, 1)?.broadcast_as((rows * dims, k))?;
        for part in 0..3 {
            let sample = samples.narrow(1, part * k, k)?;
            u = (u + sample.broadcast_mul(&rho.narrow(1, part, 1)?)?)?;
        }
        let u = u.tanh()?.reshape((rows, dims, k))?.transpose(1, 2)?.reshape((rows, k * dims))?;
        if !self.policy.carries_state() {
            return Ok(u);
        }
        let end = |at: usize| samples.narrow(1, at, 1)?.reshape((rows, dims));
        Tensor::cat(&[&u, &end(k - 1)?, &end(2 * k - 1)?], 1)
    }

    /// [observation, what the critic sees of `acts`].
    fn critic_graph(&self, flat: &Tensor, observations: &[f32], acts: &Tensor) -> Result<Tensor> {
        let shape = self.ddpg.shape;
        let seen = if shape.actions_len < shape.segment_actions_len {
            acts.narrow(1, 0, shape.actions_len)?
        } else {
            acts.clone()
        };
        let observations = self.tensor(observations, shape.observation_len);
        let inputs = Tensor::cat(&[&observations, &seen], D::Minus1)?;
        network(&self.ddpg.critic_shape, flat, &inputs)
    }

    /// Gradients of critic loss and actor loss; the actor's is taken at the updated critic.
    fn critic_gradient(&self) -> Result<Vec<f32>> {
        let target_actor = self.ddpg.actor.target.var().as_detached_tensor();
        let target_critic = self.ddpg.critic.target.var().as_detached_tensor();
        let next = &self.batch.next_observations;
        let acts = self.policy_graph(&target_actor, next)?;
        let q_next = self.critic_graph(&target_critic, next, &acts)?;
        let rewards = self.tensor(&self.batch.rewards, 1);
        let targets = (rewards + self.tensor(&self.batch.bootstrap, 1).mul(&q_next)?)?;
        let critic = Var::from_tensor(self.ddpg.critic.network.var())?;
        let inputs = self.tensor(&self.batch.critic_inputs, self.ddpg.shape.critic_inputs());
        let q = network(&self.ddpg.critic_shape, &critic, &inputs)?;
        let loss = (q - targets)?.sqr()?.mean_all()?;
        loss.backward()?.get(&critic).unwrap().to_vec1()
    }

    fn actor_gradient(&self) -> Result<Vec<f32>> {
        let actor = Var::from_tensor(self.ddpg.actor.network.var())?;
        let critic = self.ddpg.critic.network.var().as_detached_tensor();
        let observations = &self.batch.observations;
        let acts = self.policy_graph(&actor, observations)?;
        let loss = self.critic_graph(&critic, observations, &acts)?.mean_all()?.neg()?;
        loss.backward()?.get(&actor).unwrap().to_vec1()
    }
}

/// (y0, yd0) of every row and dimension, straight from the specification's table.
fn starts(case: &Case, observations: &[f32]) -> Vec<f32> {
    use dmprl_shared::config::{Start, StartVelocity};
    let o = case.policy.layout().observation_len;
    let measured = case.config.policy.start_velocity == StartVelocity::Measured;
    let speed = if measured { 5.0 * 0.02 } else { 0.0 };
    let row = |s: &[f32]| match case.config.policy.start {
        Start::Zero => [0.0; 4],
        Start::Carry => [s[4], s[6], s[5], s[7]],
        Start::Observed => [s[1].atan2(s[0]), s[2] * speed, -s[3], s[2] * speed],
    };
    observations.chunks_exact(o).flat_map(row).collect()
}

fn assert_close(name: &str, got: &[f32], expected: &[f32]) {
    let norm = |values: &mut dyn Iterator<Item = f32>| {
        values.map(|value| f64::from(value).powi(2)).sum::<f64>().sqrt()
    };
    let size = norm(&mut expected.iter().copied());
    let difference = norm(&mut got.iter().zip(expected).map(|(a, b)| a - b));
    assert!(size > 1e-6, "{name}: nothing to compare");
    assert!(difference < 1e-5 * size, "{name}: differs by {:.1e} of its norm", difference / size);
}

#[test]
fn both_gradients_equal_automatic_differentiation() {
    let cases: [&[(&str, &str)]; 8] = [
        &[],
        &[("policy.kind", "mlp")],
        &[("policy.start", "observed")],
        &[("policy.start", "observed"), ("policy.start_velocity", "zero")],
        &[("policy.start", "carry")],
        &[("dmp.forcing_scaling", "goal"), ("policy.start", "observed")],
        &[("algorithm.critic", "first"), ("algorithm.windows", "segment")],
        &[("dmp.integrator", "paper"), ("dmp.alpha_y", "25.0"), ("dmp.basis_count", "3")],
    ];
    for keys in cases {
        let mut case = case(keys);
        let critic_expected = case.critic_gradient().unwrap();
        let Case { policy, ddpg, batch, .. } = &mut case;
        ddpg.targets(policy, batch).unwrap();
        ddpg.critic_step(batch).unwrap();
        assert_close(&format!("critic, {keys:?}"), &case.ddpg.critic.gradient, &critic_expected);
        let actor_expected = case.actor_gradient().unwrap();
        let Case { policy, ddpg, batch, .. } = &mut case;
        ddpg.actor_step(policy, batch).unwrap();
        assert_close(&format!("actor, {keys:?}"), &case.ddpg.actor.gradient, &actor_expected);
    }
}

#[test]
fn updates_fit_a_known_value_and_follow_its_gradient() {
    // Reward = 1 - |first action - 0.5|², no bootstrap: Q is that bowl, and the best first action
    // is 0.5 in both dimensions whatever the observation.
    let mut case = case(&[
        ("policy.kind", "mlp"),
        ("algorithm.batch_size", "128"),
        ("algorithm.critic_learning_rate", "0.003"),
        ("algorithm.actor_learning_rate", "0.003"),
    ]);
    let mut random = seeds::stream(4, "test", 0);
    case.batch.bootstrap.fill(0.0);
    let mut losses = Losses::default();
    for _ in 0..5_000 {
        for value in &mut case.batch.critic_inputs {
            *value = random.random_range(-1.0..1.0);
        }
        for row in 0..128 {
            let input = &case.batch.critic_inputs[row * 6..(row + 1) * 6];
            case.batch.rewards[row] = 1.0 - (input[4] - 0.5).powi(2) - (input[5] - 0.5).powi(2);
            case.batch.observations[row * 4..(row + 1) * 4].copy_from_slice(&input[..4]);
        }
        losses = case.ddpg.update(&case.policy, &case.batch).unwrap();
    }
    assert!(losses.critic_loss < 0.01, "{losses:?}");
    let mut work = case.policy.workspace(128);
    let observations = &case.batch.observations;
    let act = |p: &[f32]| case.policy.act(p, observations, &mut work, Threads::ONE);
    case.ddpg.actor.network.read(act).unwrap();
    let errors = work.actions.iter().map(|u| (u - 0.5).abs());
    let mean = errors.sum::<f32>() / work.actions.len() as f32;
    assert!(mean < 0.05, "actions are {mean} away from the best on average");
}

#[test]
fn the_number_of_threads_changes_no_bit_of_an_update() {
    let run = |threads: &str| {
        let keys = [
            ("learner.threads", threads),
            ("policy.hidden", "[256, 256]"),
            ("algorithm.critic_hidden", "[256, 256]"),
            ("algorithm.batch_size", "256"),
        ];
        let mut case = case(&keys);
        let Case { policy, ddpg, batch, .. } = &mut case;
        (0..3).for_each(|_| {
            ddpg.update(policy, batch).unwrap();
        });
        ddpg.actor.network.read(<[f32]>::to_vec).unwrap()
    };
    assert_eq!(run("1"), run("2"));
}
