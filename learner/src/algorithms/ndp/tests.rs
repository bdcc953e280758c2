//! Compares the gradients with candle's automatic differentiation of the same losses, written as a
//! graph without our kernels, and checks that the algorithm finds a known optimum.

use candle_core::{Device, Tensor, Var};
use dmprl_shared::config::{Controller, ForcingScaling, Layers};
use dmprl_shared::dmp::{Dmp, SegmentMap};
use dmprl_shared::policy::PolicyWorkspace;
use dmprl_shared::segment::{SegmentHeader, TRUNCATED};
use rand::RngExt;
use rand_distr::StandardNormal;

use super::super::tests::assert_close;
use super::*;
use crate::learner::tests::spec;

const SEGMENTS: usize = 12;

/// Computes a multilayer perceptron with flat parameters as a graph.
fn network(shape: &MlpShape, flat: &Tensor, inputs: &Tensor) -> Result<Tensor> {
    let mut x = inputs.clone();
    for (index, layer) in shape.layers().iter().enumerate() {
        let weights = flat.narrow(0, layer.weights.start, layer.weights.len())?;
        let weights = weights.reshape((layer.outputs, layer.inputs))?;
        x = x.matmul(&weights.t()?)?;
        x = x.broadcast_add(&flat.narrow(0, layer.bias.start, layer.bias.len())?)?;
        x = if index + 1 < shape.layers().len() { x.relu()? } else { x };
    }
    Ok(x)
}

struct Case {
    config: ExperimentConfig,
    policy: Policy,
    ndp: Ndp,
    random: Stream,
}

fn case(keys: &[(&str, &str)]) -> Case {
    let mut layers = Layers::new();
    let common = [
        ("algorithm.name", "ndp"),
        ("exploration.warm_up_steps", "0"),
        ("policy.hidden", "[24, 16]"),
        ("policy.controller", "position"),
        ("policy.position_scale", "3.0"),
        ("policy.start", "observed"),
        ("policy.start_velocity", "zero"),
        ("dmp.forcing_scaling", "goal"),
        ("dmp.integrator", "explicit"),
        ("algorithm.critic_hidden", "[20, 12]"),
        ("algorithm.ndp.rollout_segments", "12"),
        ("algorithm.ndp.minibatches", "1"),
        ("algorithm.ndp.gradient_norm_max", "1e9"),
        ("algorithm.ndp.initial_log_std", "-0.7"),
        ("algorithm.ndp.learning_rate_decay", "none"),
        ("actors.workers", "1"),
        ("task.start_sources", "[{cos=0, sin=1, velocity=2}, {index=3, velocity=2, scale=-1.0}]"),
    ];
    for (key, value) in common.iter().chain(keys) {
        layers.set("test", key, value).unwrap();
    }
    let config = layers.finish().unwrap();
    let policy = Policy::new(config.policy_description(&spec())).unwrap();
    let mut ndp = Ndp::new(&config, &policy).unwrap();
    ndp.policy_published(1);
    Case { config, policy, ndp, random: seeds::stream(3, "test", 0) }
}

impl Case {
    fn parameters(&self) -> Vec<f32> {
        let mut values = vec![0.0; self.policy.parameters_len()];
        self.ndp.read_policy(&mut values);
        values
    }

    fn update(&mut self) -> NdpLosses {
        self.update_at(0.0)
    }

    fn update_at(&mut self, progress: f64) -> NdpLosses {
        let context = UpdateContext { policy: &self.policy, normaliser: None, progress };
        self.ndp.update(context, &mut self.random)
    }

    /// Runs the policy for an episode of one segment on a random observation, with `reward` of its
    /// actions.
    fn segment(
        &mut self,
        work: &mut PolicyWorkspace,
        reward: impl Fn(&[f32]) -> [f32; 5],
    ) -> Segment {
        let layout = self.policy.layout();
        let mut segment = Segment::zeroed(layout);
        let (observations, actions, rewards) = layout.split_mut(&mut segment.block);
        observations.iter_mut().for_each(|value| *value = self.random.random_range(-1.0..1.0));
        let parameters = self.parameters();
        self.policy.act(&parameters, &observations[..layout.observation_len], work);
        let log_std = self.policy.learned_std().unwrap().log_std(&parameters);
        for (index, (action, mean)) in actions.iter_mut().zip(&work.actions).enumerate() {
            let noise: f32 = self.random.sample(StandardNormal);
            *action = mean + log_std[index % 2].exp() * noise;
        }
        rewards.copy_from_slice(&reward(actions));
        segment.header = SegmentHeader {
            policy_version: 1,
            steps_len: 5,
            flags: TRUNCATED,
            ..SegmentHeader::default()
        };
        segment
    }

    /// Fills the rollout. Every third segment is cut short.
    fn fill(&mut self) {
        let mut work = self.policy.workspace(1);
        for number in 0..SEGMENTS {
            let mut segment = self.segment(&mut work, |actions| {
                std::array::from_fn(|step| actions[2 * step] - actions[2 * step + 1].abs())
            });
            segment.header.steps_len = if number % 3 == 0 { 2 } else { 5 };
            assert!(self.ndp.try_insert(&segment));
        }
    }

    /// Computes the means of u, (N, K A), for the rollout's observations.
    fn means_graph(&self, flat: &Tensor) -> Result<Tensor> {
        let (k, n, dims) = (5, self.config.dmp.basis_count, 2);
        let observations = &self.ndp.rollout.observations;
        let inputs = Tensor::from_slice(observations, (SEGMENTS, 4), &Device::Cpu)?;
        let outputs = network(self.policy.shape(), flat, &inputs)?;
        let cells = outputs.reshape((SEGMENTS * dims, self.policy.shape().outputs() / dims))?;
        let dmp = Dmp::new(&self.config.dmp, k).unwrap();
        let map = SegmentMap::new(&dmp, dmp.omega() * dmp.omega());
        let matrix = Tensor::from_slice(map.matrix(), (3 * k, 3 + n), &Device::Cpu)?;
        let starts = observations.chunks_exact(4).flat_map(|s| [s[1].atan2(s[0]), -s[3]]);
        let y0 = Tensor::from_vec(starts.collect::<Vec<_>>(), (SEGMENTS * dims, 1), &Device::Cpu)?;
        let goal = cells.narrow(1, 0, 1)?.tanh()?;
        let mut weights = cells.narrow(1, 1, n)?.tanh()?;
        if self.config.dmp.forcing_scaling == ForcingScaling::Goal {
            weights = weights.broadcast_mul(&(&goal - &y0)?)?;
        }
        let samples =
            Tensor::cat(&[&y0, &y0.zeros_like()?, &goal, &weights], 1)?.matmul(&matrix.t()?)?;
        let y = samples.narrow(1, 0, k)?;
        let u = match self.config.policy.controller {
            Controller::Direct => y.tanh()?,
            Controller::Position => {
                let before = Tensor::cat(&[&y0, &y.narrow(1, 0, k - 1)?], 1)?;
                ((y - before)? * self.config.policy.position_scale)?
            }
            Controller::Inverse => {
                let rho = (cells.narrow(1, n + 1, 4)?.tanh()? * 2.0)?;
                let mut u = (y + rho.narrow(1, 3, 1)?.broadcast_as((SEGMENTS * dims, k))?)?;
                for part in 0..3 {
                    let sample = samples.narrow(1, part * k, k)?;
                    u = (u + sample.broadcast_mul(&rho.narrow(1, part, 1)?)?)?;
                }
                u.tanh()?
            }
        };
        u.reshape((SEGMENTS, dims, k))?.transpose(1, 2)?.reshape((SEGMENTS, k * dims))
    }

    /// Computes the log densities of the rollout's steps, (N, K).
    fn densities_graph(&self, flat: &Tensor, log_std: &Tensor) -> Result<Tensor> {
        let actions = &self.ndp.rollout.actions;
        let actions = Tensor::from_slice(actions, (SEGMENTS, 5, 2), &Device::Cpu)?;
        let means = self.means_graph(flat)?.reshape((SEGMENTS, 5, 2))?;
        let z = (actions - means)?.broadcast_div(&log_std.exp()?)?;
        let normal = ((z.sqr()? + (2.0 * std::f64::consts::PI).ln())? * -0.5)?;
        normal.broadcast_sub(log_std)?.sum(2)
    }

    /// Computes the gradients of the policy's loss at `now` with respect to network and log std.
    /// The rollout was made with the parameters `before`.
    fn policy_gradients(&self, before: &[f32], now: &[f32]) -> Result<[Vec<f32>; 2]> {
        let len = self.policy.shape().parameters_len();
        let part = |values: &[f32]| Tensor::from_slice(values, values.len(), &Device::Cpu);
        let old = self.densities_graph(&part(&before[..len])?, &part(&before[len..])?)?;
        let flat = Var::from_tensor(&part(&now[..len])?)?;
        let log_std = Var::from_tensor(&part(&now[len..])?)?;
        let ratio = (self.densities_graph(&flat, &log_std)? - old)?.exp()?;
        let advantages = part(&self.ndp.rollout.advantages)?.reshape((SEGMENTS, 1))?;
        let plain = ratio.broadcast_mul(&advantages)?;
        let clipped = ratio.clamp(0.9, 1.1)?.broadcast_mul(&advantages)?;
        let steps = self.ndp.rollout.steps_len.iter();
        let mask: Vec<f32> = steps
            .flat_map(|steps| (0..5).map(move |step| f32::from(u8::from(step < *steps))))
            .collect();
        let count = mask.iter().sum::<f32>();
        let mask = Tensor::from_vec(mask, (SEGMENTS, 5), &Device::Cpu)?;
        let surrogate = (plain.minimum(&clipped)?.mul(&mask)?.sum_all()? / f64::from(count))?;
        let entropy = log_std.sum_all()?;
        let loss = (surrogate.neg()? - (entropy * 0.01)?)?;
        let gradients = loss.backward()?;
        Ok([gradients.get(&flat).unwrap().to_vec1()?, gradients.get(&log_std).unwrap().to_vec1()?])
    }

    fn value_gradient(&self, now: &[f32]) -> Result<Vec<f32>> {
        let flat = Var::from_slice(now, now.len(), &Device::Cpu)?;
        let rollout = &self.ndp.rollout;
        let inputs = Tensor::from_slice(&rollout.observations, (SEGMENTS, 4), &Device::Cpu)?;
        let values = network(&self.ndp.critic.shape, &flat, &inputs)?;
        let returns = Tensor::from_slice(&rollout.returns, (SEGMENTS, 1), &Device::Cpu)?;
        let loss = (values - returns)?.sqr()?.mean_all()?;
        loss.backward()?.get(&flat).unwrap().to_vec1()
    }
}

#[test]
fn gradients_equal_automatic_differentiation_before_and_after_the_policy_has_moved() {
    let cases: [&[(&str, &str)]; 4] = [
        &[],
        &[("dmp.forcing_scaling", "none"), ("dmp.integrator", "semi_implicit")],
        &[("policy.controller", "inverse")],
        &[("policy.controller", "direct")],
    ];
    for keys in cases {
        let fast = [("algorithm.actor_learning_rate", "0.01")];
        let mut case = case(&[keys, &fast].concat());
        let before = case.parameters();
        case.fill();
        let mut beyond = 0.0;
        for step in 0..4 {
            let (now, value) = (case.parameters(), case.ndp.critic.parameters.values().to_vec());
            let losses = case.update();
            let [actor, log_std] = case.policy_gradients(&before, &now).unwrap();
            let name = |part| format!("{part}, step {step}, {keys:?}");
            assert_close(&name("actor"), case.ndp.actor.gradient(), &actor);
            assert_close(&name("log std"), case.ndp.log_std.gradient(), &log_std);
            let value = case.value_gradient(&value).unwrap();
            assert_close(&name("value"), case.ndp.critic.gradient(), &value);
            if step == 0 {
                // The policy is still the one that acted.
                assert!(losses.approx_kl.abs() < 1e-6 && losses.clip_fraction == 0.0, "{losses:?}");
            }
            beyond = losses.clip_fraction.max(beyond);
        }
        assert!(beyond > 0.1, "only {beyond} of the steps met the clip");
    }
}

#[test]
fn a_gradient_longer_than_the_limit_is_shortened_to_it() {
    let mut case = case(&[("algorithm.ndp.gradient_norm_max", "0.001")]);
    case.fill();
    case.update();
    let ndp = &case.ndp;
    let policy = (ndp.actor.gradient_square() + ndp.log_std.gradient_square()).sqrt();
    let value = ndp.critic.gradient_square().sqrt();
    assert!((policy - 1e-3).abs() < 1e-8 && (value - 1e-3).abs() < 1e-8, "{policy} {value}");
}

#[test]
fn only_segments_of_the_policy_as_it_is_are_learned_from() {
    let mut case = case(&[("algorithm.ndp.epochs", "1"), ("algorithm.ndp.minibatches", "2")]);
    let mut work = case.policy.workspace(1);
    let mut segment = case.segment(&mut work, |_| [0.0; 5]);
    // Drawn before the worker had received the first policy.
    segment.header.policy_version = 0;
    assert!(!case.ndp.try_insert(&segment));
    segment.header.policy_version = 1;
    assert!(case.ndp.try_insert(&segment));
    // Published again for an evaluation: the same policy under another version.
    case.ndp.policy_published(2);
    segment.header.policy_version = 2;
    assert!(case.ndp.try_insert(&segment));
    (2..SEGMENTS).for_each(|_| assert!(case.ndp.try_insert(&segment)));
    assert!(case.ndp.update_due() && !case.ndp.try_insert(&segment));
    case.update();
    assert!(case.ndp.update_due(), "one of two minibatches is left");
    case.update();
    // The policy has changed: segments are stale until the new one has been published and has
    // acted.
    assert!(!case.ndp.update_due() && !case.ndp.try_insert(&segment));
    case.ndp.policy_published(3);
    assert!(!case.ndp.try_insert(&segment));
    segment.header.policy_version = 3;
    assert!(case.ndp.try_insert(&segment));
    assert_eq!(case.ndp.rollout.len(), 1);
}

#[test]
fn the_learning_rate_falls_to_zero_with_the_run() {
    let mut case = case(&[("algorithm.ndp.learning_rate_decay", "linear")]);
    case.fill();
    let before = case.parameters();
    case.update_at(1.0);
    assert_eq!(case.parameters(), before);
    case.update_at(0.5);
    assert_ne!(case.parameters(), before);
}

#[test]
fn the_number_of_threads_changes_no_bit_of_an_update() {
    let run = |threads: &str| {
        // More than one shard, the last not full.
        let keys = [("algorithm.ndp.rollout_segments", "150"), ("learner.threads", threads)];
        let mut case = case(&keys);
        let mut work = case.policy.workspace(1);
        for _ in 0..150 {
            let segment = case.segment(&mut work, |actions| [actions[0]; 5]);
            assert!(case.ndp.try_insert(&segment));
        }
        for _ in 0..3 {
            case.update();
        }
        case.parameters()
    };
    assert_eq!(run("1"), run("3"));
}

#[test]
fn it_finds_the_best_first_action_of_a_bandit() {
    // Reward = -|first action - (0.4, -0.3)|²: the best mean is that point, whatever is observed.
    let mut case = case(&[
        ("algorithm.ndp.rollout_segments", "64"),
        ("algorithm.ndp.minibatches", "4"),
        ("algorithm.ndp.epochs", "5"),
        ("algorithm.actor_learning_rate", "0.003"),
        ("algorithm.critic_learning_rate", "0.003"),
        ("algorithm.ndp.entropy_coefficient", "0.0"),
        ("policy.start", "zero"),
    ]);
    let mut work = case.policy.workspace(1);
    let mut error = f32::NAN;
    for rollout in 1..=150 {
        let mut sum = 0.0;
        while !case.ndp.update_due() {
            let segment = case.segment(&mut work, |actions| {
                let off = (actions[0] - 0.4).powi(2) + (actions[1] + 0.3).powi(2);
                [-off, 0.0, 0.0, 0.0, 0.0]
            });
            sum += (work.actions[0] - 0.4).abs() + (work.actions[1] + 0.3).abs();
            assert!(case.ndp.try_insert(&Segment {
                header: SegmentHeader { policy_version: rollout, ..segment.header },
                ..segment
            }));
        }
        error = sum / 128.0;
        while case.ndp.update_due() {
            case.update();
        }
        case.ndp.policy_published(rollout + 1);
    }
    assert!(error < 0.08, "means are {error} away from the best on average");
    let log_std = case.ndp.log_std.parameters.values();
    assert!(log_std.iter().all(|value| *value < -1.2), "still explores: {log_std:?}");
}
