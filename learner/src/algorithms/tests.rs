//! The hand-derived gradients against candle's automatic differentiation of the same losses,
//! written out as a graph with none of our kernels.

use candle_core::{D, Device, Tensor, Var};
use dmprl_shared::config::{ForcingScaling, Layers};
use dmprl_shared::dmp::{Dmp, SegmentMap};
use dmprl_shared::policy::Head;
use rand::RngExt;

use super::*;
use crate::learner::tests::spec;
use crate::networks::Parameters;

struct Case {
    config: ExperimentConfig,
    policy: Policy,
    algorithm: Algorithm,
    batch: Batch,
}

fn case(keys: &[(&str, &str)]) -> Case {
    let mut layers = Layers::new();
    let common = [
        ("policy.hidden", "[24, 16]"),
        ("algorithm.critic_hidden", "[20, 12]"),
        // More than one block of rows, the last not full.
        ("algorithm.batch_size", "80"),
        ("algorithm.td3.actor_interval", "1"),
        ("algorithm.sac.initial_temperature", "0.3"),
        ("task.start_sources", "[{cos=0, sin=1, velocity=2}, {index=3, velocity=2, scale=-1.0}]"),
    ];
    for (key, value) in common.iter().chain(keys) {
        layers.set("test", key, value).unwrap();
    }
    let config = layers.finish().unwrap();
    let policy = Policy::new(&config, &spec()).unwrap();
    let mut algorithm = Algorithm::new(&config, &policy).unwrap();
    // Targets that differ from their networks, so that mixing them up shows.
    let mut random = seeds::stream(3, "test", 0);
    let disturb = |_, trained: &mut Trained| match &trained.target {
        Some(target) => target.update(|values| {
            values.iter_mut().for_each(|value| *value += random.random_range(-0.05..0.05));
        }),
        None => Ok(()),
    };
    algorithm.each_network(disturb).unwrap();
    let mut batch = Batch::new(algorithm.batch_shape());
    let mut fill = |values: &mut [f32]| {
        values.iter_mut().for_each(|value| *value = random.random_range(-1.0..1.0));
    };
    fill(&mut batch.observations);
    batch.inputs.copy_from_slice(&batch.observations);
    fill(&mut batch.critic_inputs);
    fill(&mut batch.rewards);
    fill(&mut batch.bootstrap);
    fill(&mut batch.next_observations);
    batch.next_inputs.copy_from_slice(&batch.next_observations);
    fill(&mut batch.next_noise);
    fill(&mut batch.noise);
    Case { config, policy, algorithm, batch }
}

/// Parameters of all networks and targets, by name.
struct Moment(Vec<(&'static str, Tensor, Option<Tensor>)>);

impl Moment {
    fn of(algorithm: &Algorithm) -> Self {
        let copy = |parameters: &Parameters| parameters.var().copy().unwrap();
        let networks = algorithm.networks().into_iter();
        Self(
            networks
                .map(|(name, t)| (name, copy(&t.network), t.target.as_ref().map(copy)))
                .collect(),
        )
    }

    fn network(&self, wanted: &str) -> &Tensor {
        &self.0.iter().find(|(name, ..)| *name == wanted).unwrap().1
    }

    fn target(&self, wanted: &str) -> &Tensor {
        self.0.iter().find(|(name, ..)| *name == wanted).unwrap().2.as_ref().unwrap()
    }
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

    /// Means before tanh (B, K A), end state (B, 2A) if carried, and raw log-stds (B, K A) if any.
    fn policy_graph(&self, flat: &Tensor, observations: &[f32]) -> Result<[Option<Tensor>; 3]> {
        let layout = self.policy.layout();
        let o = layout.observation_len;
        let outputs = network(self.policy.shape(), flat, &self.tensor(observations, o))?;
        let columns = self.policy.log_stds();
        let log_std = columns.map(|c| outputs.narrow(1, c.start, c.len())).transpose()?;
        let head = outputs.dim(1)? - log_std.as_ref().map_or(0, |_| layout.actions_len());
        let outputs = outputs.narrow(1, 0, head)?;
        match self.policy.head() {
            Head::Mlp => Ok([Some(outputs), None, log_std]),
            Head::Dmp(_) => {
                let [means, end] = self.dmp_graph(&outputs.contiguous()?, observations)?;
                Ok([means, end, log_std])
            }
        }
    }

    /// What the critic gets of the policy, (B, K A + 2A or 0).
    fn acts_graph(&self, flat: &Tensor, observations: &[f32]) -> Result<Tensor> {
        let [means, end, _] = self.policy_graph(flat, observations)?;
        joined(&means.unwrap().tanh()?, end)
    }

    /// The same of a draw, and its log density (B, 1), in the plain form of the formula.
    fn draw_graph(
        &self,
        flat: &Tensor,
        observations: &[f32],
        noise: &[f32],
    ) -> Result<[Tensor; 2]> {
        let [means, end, log_std] = self.policy_graph(flat, observations)?;
        let (means, log_std) = (means.unwrap(), log_std.unwrap().clamp(-20.0, 2.0)?);
        let noise = self.tensor(noise, means.dim(1)?);
        let u = (means + (log_std.exp()? * &noise)?)?.tanh()?;
        let normal = ((noise.sqr()? + (2.0 * std::f64::consts::PI).ln())? * -0.5)?;
        let density = ((normal - log_std)? - u.sqr()?.affine(-1.0, 1.0)?.log()?)?;
        Ok([joined(&u, end)?, density.sum_keepdim(1)?])
    }

    fn dmp_graph(&self, outputs: &Tensor, observations: &[f32]) -> Result<[Option<Tensor>; 2]> {
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
        let u = u.reshape((rows, dims, k))?.transpose(1, 2)?.reshape((rows, k * dims))?;
        if !self.policy.carries_state() {
            return Ok([Some(u), None]);
        }
        let end = |at: usize| samples.narrow(1, at, 1)?.reshape((rows, dims));
        Ok([Some(u), Some(Tensor::cat(&[&end(k - 1)?, &end(2 * k - 1)?], 1)?)])
    }

    /// Q of [observation, what the critic sees of `acts`].
    fn q_graph(&self, flat: &Tensor, observations: &[f32], acts: &Tensor) -> Result<Tensor> {
        let shape = self.algorithm.batch_shape();
        let seen = if shape.actions_len < shape.segment_actions_len {
            acts.narrow(1, 0, shape.actions_len)?
        } else {
            acts.clone()
        };
        let observations = self.tensor(observations, shape.observation_len);
        let inputs = Tensor::cat(&[&observations, &seen], D::Minus1)?;
        self.critic_graph(flat, &inputs)
    }

    fn critic_graph(&self, flat: &Tensor, inputs: &Tensor) -> Result<Tensor> {
        let networks = self.algorithm.networks();
        let (_, critic) = networks.iter().find(|(name, _)| name.starts_with("critic")).unwrap();
        network(&critic.shape, flat, inputs)
    }

    fn targets(&self, before: &Moment) -> Result<Tensor> {
        let next = &self.batch.next_observations;
        let twins = |acts: &Tensor| -> Result<Tensor> {
            let first = self.q_graph(before.target("critic_1"), next, acts)?;
            first.minimum(&self.q_graph(before.target("critic_2"), next, acts)?)
        };
        let value = match self.config.algorithm.name {
            AlgorithmName::Ddpg => {
                let acts = self.acts_graph(before.target("actor"), next)?;
                self.q_graph(before.target("critic"), next, &acts)?
            }
            AlgorithmName::Td3 => {
                let [means, end, _] = self.policy_graph(before.target("actor"), next)?;
                let u = means.unwrap().tanh()?;
                let noise = (self.tensor(&self.batch.next_noise, u.dim(1)?) * 0.2)?;
                let u = (u + noise.clamp(-0.5, 0.5)?)?.clamp(-1.0, 1.0)?;
                twins(&joined(&u, end)?)?
            }
            AlgorithmName::Sac => {
                let actor = before.network("actor");
                let [acts, density] = self.draw_graph(actor, next, &self.batch.next_noise)?;
                let temperature = before.network("log_temperature").exp()?;
                (twins(&acts)? - density.broadcast_mul(&temperature)?)?
            }
        };
        self.tensor(&self.batch.rewards, 1) + self.tensor(&self.batch.bootstrap, 1).mul(&value)?
    }

    /// The gradient of (Q - target)² of one critic.
    fn critic_gradient(&self, name: &str, before: &Moment) -> Result<Vec<f32>> {
        let critic = Var::from_tensor(before.network(name))?;
        let width = self.algorithm.batch_shape().critic_inputs();
        let q = self.critic_graph(&critic, &self.tensor(&self.batch.critic_inputs, width))?;
        let loss = (q - self.targets(before)?)?.sqr()?.mean_all()?;
        loss.backward()?.get(&critic).unwrap().to_vec1()
    }

    /// The gradient of the actor's loss, at the critics after their step.
    fn actor_gradient(&self, before: &Moment, after: &Moment) -> Result<Vec<f32>> {
        let actor = Var::from_tensor(before.network("actor"))?;
        let observations = &self.batch.observations;
        let loss = match self.config.algorithm.name {
            AlgorithmName::Sac => {
                let [acts, density] = self.draw_graph(&actor, observations, &self.batch.noise)?;
                let q = self.q_graph(after.network("critic_1"), observations, &acts)?;
                let q =
                    q.minimum(&self.q_graph(after.network("critic_2"), observations, &acts)?)?;
                let temperature = before.network("log_temperature").exp()?;
                (density.broadcast_mul(&temperature)? - q)?.mean_all()?
            }
            name => {
                let critic = if name == AlgorithmName::Td3 { "critic_1" } else { "critic" };
                let acts = self.acts_graph(&actor, observations)?;
                self.q_graph(after.network(critic), observations, &acts)?.mean_all()?.neg()?
            }
        };
        loss.backward()?.get(&actor).unwrap().to_vec1()
    }

    fn check(&mut self, what: &str) {
        let before = Moment::of(&self.algorithm);
        let losses = self.algorithm.update(&self.policy, &self.batch, 1).unwrap();
        let after = Moment::of(&self.algorithm);
        for (name, trained) in self.algorithm.networks() {
            let expected = match name {
                "actor" => self.actor_gradient(&before, &after).unwrap(),
                "log_temperature" => {
                    let entropy_target = -0.5 * self.policy.layout().actions_len() as f32;
                    vec![losses.entropy.unwrap() - entropy_target]
                }
                critic => self.critic_gradient(critic, &before).unwrap(),
            };
            assert_close(&format!("{name}, {what}"), trained.gradient(), &expected);
        }
    }
}

fn joined(u: &Tensor, end: Option<Tensor>) -> Result<Tensor> {
    match end {
        Some(end) => Tensor::cat(&[u, &end], 1),
        None => Ok(u.clone()),
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
fn every_gradient_equals_automatic_differentiation() {
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
    for algorithm in ["ddpg", "td3", "sac"] {
        for keys in cases {
            let all: Vec<_> = keys.iter().copied().chain([("algorithm.name", algorithm)]).collect();
            case(&all).check(&format!("{algorithm} {keys:?}"));
        }
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
            case.batch.inputs[row * 4..(row + 1) * 4].copy_from_slice(&input[..4]);
        }
        losses = case.algorithm.update(&case.policy, &case.batch, 1).unwrap();
    }
    assert!(losses.critic_loss < 0.01, "{losses:?}");
    let mut work = case.policy.workspace(128);
    let observations = &case.batch.inputs;
    let act = |p: &[f32]| case.policy.act(p, observations, &mut work);
    case.algorithm.actor().network.read(act).unwrap();
    let errors = work.actions.iter().map(|u| (u - 0.5).abs());
    let mean = errors.sum::<f32>() / work.actions.len() as f32;
    assert!(mean < 0.05, "actions are {mean} away from the best on average");
}

#[test]
fn the_number_of_threads_changes_no_bit_of_an_update() {
    for algorithm in ["ddpg", "td3", "sac"] {
        let run = |threads: &str| {
            let keys = [
                ("algorithm.name", algorithm),
                ("learner.threads", threads),
                ("policy.hidden", "[256, 256]"),
                ("algorithm.critic_hidden", "[256, 256]"),
                ("algorithm.batch_size", "250"),
            ];
            let mut case = case(&keys);
            for update in 1..=3 {
                case.algorithm.update(&case.policy, &case.batch, update).unwrap();
            }
            let networks = case.algorithm.networks().into_iter();
            let read = |network: &Parameters| network.read(<[f32]>::to_vec).unwrap();
            networks
                .map(|(_, t)| (read(&t.network), t.target.as_ref().map(read)))
                .collect::<Vec<_>>()
        };
        let one = run("1");
        assert!(one == run("2") && one == run("7"), "{algorithm}");
    }
}
