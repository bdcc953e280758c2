//! Compares the hand-derived updates with candle's automatic differentiation of the same losses,
//! which uses none of our kernels.

use std::iter;

use dmprl_shared::config::Layers;
use parking_lot::{Mutex, MutexGuard};
use rand::RngExt;

use super::*;
use crate::learner::tests::{goal_rule, spec};
use crate::parameters::Parameters;
use crate::update::network::TrainableNetwork;

pub(super) struct Case {
    config: ExperimentConfig,
    rule: Option<GoalRule>,
    pub(super) policy: Policy,
    pub(super) algorithm: Algorithm,
    pub(super) batch: Batch,
}

pub(super) fn case(keys: &[(&str, &str)]) -> Case {
    case_with(keys, None)
}

fn case_with(keys: &[(&str, &str)], rule: Option<GoalRule>) -> Case {
    let mut layers = Layers::new();
    let common = [
        ("policy.hidden", "[24, 16]"),
        ("algorithm.critic_hidden", "[20, 12]"),
        // More than one shard of rows, the last not full.
        ("algorithm.batch_size", "80"),
        ("algorithm.td3.actor_interval", "1"),
        ("algorithm.sac.initial_temperature", "0.3"),
        ("task.start_sources", "[{cos=0, sin=1, velocity=2}, {index=3, velocity=2, scale=-1.0}]"),
    ];
    for (key, value) in common.iter().chain(keys) {
        layers.set("test", key, value).unwrap();
    }
    let config = layers.finish().unwrap();
    let policy = Policy::new(config.policy_description(&spec())).unwrap();
    let mut algorithm = Algorithm::new(&config, &policy, rule.as_ref()).unwrap();
    // Targets differ from their networks, so that confusing them fails the test. Gains and shifts
    // differ from one and zero.
    let mut random = seeds::stream(3, "test", 0);
    let disturb = |_, network: &mut TrainableNetwork| {
        let networks = [Some(&mut network.parameters), network.target.as_mut()];
        let values = networks.into_iter().flatten().flat_map(Parameters::values_mut);
        values.for_each(|value| *value += random.random_range(-0.05..0.05));
        Ok::<(), ()>(())
    };
    algorithm.for_each_network(disturb).unwrap();
    let mut batch = Batch::new(algorithm.batch_shape());
    let mut fill = |values: &mut [f32]| {
        values.iter_mut().for_each(|value| *value = random.random_range(-1.0..1.0));
    };
    // Network inputs differ from the states of the DMP, so that confusing them fails the test.
    fill(&mut batch.observations);
    fill(&mut batch.inputs);
    fill(&mut batch.critic_inputs);
    fill(&mut batch.rewards);
    fill(&mut batch.bootstrap);
    fill(&mut batch.next_observations);
    fill(&mut batch.next_inputs);
    fill(&mut batch.next_noise);
    fill(&mut batch.noise);
    fill(&mut batch.previous_actions);
    fill(&mut batch.motion);
    // Rows with no, one and two actions before them.
    for (row, has) in batch.has_previous.chunks_exact_mut(2).enumerate() {
        has.copy_from_slice([&[0.0, 0.0], &[0.0, 1.0], &[1.0, 1.0]][row % 3]);
    }
    if config.algorithm.imitates() {
        batch.led_to_goal.iter_mut().step_by(2).for_each(|led| *led = 1.0);
    }
    Case { config, rule, policy, algorithm, batch }
}

/// Waits until no other test uses the GPU. CUDA can record no update while another thread opens the
/// same GPU.
pub(super) fn alone_on_gpu() -> Option<MutexGuard<'static, ()>> {
    static GPU: Mutex<()> = Mutex::new(());
    cfg!(feature = "cuda").then(|| GPU.lock())
}

/// The devices of graphs here: candle's CPU and, in a build with the feature `cuda`, the GPU that
/// such a build is tested on.
fn devices() -> Vec<Device> {
    let gpu = cfg!(feature = "cuda").then(|| graph::open_gpu().unwrap());
    iter::once(Device::Cpu).chain(gpu).collect()
}

impl Case {
    /// Compares one update by our kernels with one by candle's graph on each device, from the same
    /// state.
    pub(super) fn check(&mut self, what: &str) {
        let _alone = alone_on_gpu();
        let devices = devices();
        let expected: Vec<_> = devices.iter().map(|device| self.update_graph(device)).collect();
        let losses = self.algorithm.update(&self.policy, &self.batch, 1).unwrap();
        for (device, (expected_losses, reference)) in devices.iter().zip(expected) {
            let what = format!("{what}, {:?}", device.location());
            self.compare(losses, expected_losses, &reference, &what);
        }
    }

    /// Returns losses and networks after one update by candle's graph.
    fn update_graph(&self, device: &Device) -> (Losses, Algorithm) {
        let (shape, networks) = (self.algorithm.batch_shape(), self.algorithm.networks());
        let mut graph = Graph::new(&self.config, &self.policy, shape, device, &networks).unwrap();
        let losses = graph.update(&self.policy, &self.batch, 1).unwrap();
        let mut updated = Algorithm::new(&self.config, &self.policy, self.rule.as_ref()).unwrap();
        updated.for_each_network(|name, network| graph.fetch(name, network)).unwrap();
        (losses, updated)
    }

    fn compare(&self, losses: Losses, want_losses: Losses, reference: &Algorithm, what: &str) {
        let numbers = |losses: Losses| {
            let Losses { critic_loss, actor_loss, q_mean, temperature, entropy } = losses;
            let optional = [actor_loss, temperature, entropy].into_iter().flatten();
            optional.chain([critic_loss, q_mean]).collect::<Vec<f32>>()
        };
        assert_close(&format!("losses, {what}"), &numbers(losses), &numbers(want_losses));
        let read = |network: &Parameters| network.values().to_vec();
        for ((name, got), (_, want)) in
            self.algorithm.networks().into_iter().zip(reference.networks())
        {
            let check = |part: &str, got: &[f32], want: &[f32]| {
                assert_close(&format!("{part} of {name}, {what}"), got, want);
            };
            check("gradient", got.gradient(), want.gradient());
            check("parameters", &read(&got.parameters), &read(&want.parameters));
            if let (Some(got), Some(want)) = (&got.target, &want.target) {
                check("target", &read(got), &read(want));
            }
        }
    }
}

pub(super) fn assert_close(name: &str, got: &[f32], expected: &[f32]) {
    assert_within(1e-5, name, got, expected);
}

fn assert_within(tolerance: f64, name: &str, got: &[f32], expected: &[f32]) {
    let norm = |values: &mut dyn Iterator<Item = f32>| {
        values.map(|value| f64::from(value).powi(2)).sum::<f64>().sqrt()
    };
    let size = norm(&mut expected.iter().copied());
    let difference = norm(&mut got.iter().zip(expected).map(|(a, b)| a - b));
    assert!(size > 1e-6, "{name}: nothing to compare");
    assert!(
        difference < tolerance * size,
        "{name}: differs by {:.1e} of its norm",
        difference / size
    );
}

#[test]
fn an_update_equals_automatic_differentiation() {
    let cases: [&[(&str, &str)]; 22] = [
        &[],
        &[("policy.kind", "mlp")],
        &[("policy.kind", "chunk")],
        &[("policy.start", "observed")],
        &[("policy.start", "observed"), ("policy.start_velocity", "zero")],
        &[("policy.start", "carry"), ("policy.rho", "free")],
        &[("dmp.forcing_scaling", "goal"), ("policy.start", "observed")],
        &[("algorithm.critic", "first"), ("algorithm.windows", "segment")],
        &[("dmp.integrator", "paper"), ("dmp.alpha_y", "25.0"), ("dmp.basis_count", "3")],
        &[("algorithm.critic_layer_norm", "true"), ("policy.start", "carry")],
        &[("algorithm.critic_layer_norm", "true"), ("policy.kind", "mlp")],
        &[("algorithm.td3.target_smaller_weight", "0.75")],
        &[("algorithm.action_rate_penalty", "0.7")],
        &[("algorithm.action_rate_penalty", "0.7"), ("policy.kind", "mlp")],
        &[("algorithm.action_rate_penalty", "0.7"), ("policy.kind", "chunk")],
        &[("algorithm.action_rate_penalty", "0.7"), ("policy.start", "carry")],
        &[("algorithm.action_acceleration_penalty", "0.7")],
        &[("algorithm.action_acceleration_penalty", "0.7"), ("policy.kind", "mlp")],
        &[("algorithm.imitation_penalty", "0.7")],
        &[("algorithm.imitation_penalty", "0.7"), ("policy.start", "carry")],
        &[("policy.start", "action"), ("policy.controller", "direct")],
        &[("policy.start", "action"), ("algorithm.action_acceleration_penalty", "0.3")],
    ];
    for algorithm in ["ddpg", "td3", "sac"] {
        for keys in cases {
            let all: Vec<_> = keys.iter().copied().chain([("algorithm.name", algorithm)]).collect();
            case(&all).check(&format!("{algorithm} {keys:?}"));
        }
    }
}

#[test]
fn a_saturated_actor_is_penalised_as_by_automatic_differentiation() {
    let cases: [&[(&str, &str)]; 3] =
        [&[], &[("policy.kind", "chunk")], &[("policy.rho", "free"), ("policy.start", "carry")]];
    for algorithm in ["ddpg", "td3", "sac"] {
        for keys in cases {
            let own = [("algorithm.name", algorithm), ("algorithm.saturation_penalty", "0.7")];
            let all: Vec<_> = keys.iter().copied().chain(own).collect();
            let mut saturated = case(&all);
            let grow = |name: &str, network: &mut TrainableNetwork| {
                if name == "actor" {
                    network.parameters.values_mut().iter_mut().for_each(|value| *value *= 4.0);
                }
                Ok::<(), std::convert::Infallible>(())
            };
            saturated.algorithm.for_each_network(grow).unwrap();
            saturated.check(&format!("{algorithm} {keys:?}"));
        }
    }
}

/// Checks that the networks on the host equal those fetched from another device, after `what`.
fn assert_fetched(here: &mut Case, there: &mut Case, what: &str) {
    let mut newest = vec![0.0; here.policy.parameters_len()];
    there.algorithm.read_policy(&mut newest).unwrap();
    there.algorithm.fetch().unwrap();
    let networks = here.algorithm.networks().into_iter().zip(there.algorithm.networks());
    for ((name, want), (_, got)) in networks {
        let check = |part: &str, got: &[f32], want: &[f32]| {
            assert_within(1e-4, &format!("{part} of {name} {what}"), got, want);
        };
        if name == "actor" {
            assert_eq!(got.parameters.values(), &newest[..got.parameters.values().len()], "{what}");
        }
        check("parameters", got.parameters.values(), want.parameters.values());
        check("moments", &got.adam.moments.first, &want.adam.moments.first);
        check("moments", &got.adam.moments.second, &want.adam.moments.second);
        if let (Some(got), Some(want)) = (&got.target, &want.target) {
            check("target", got.values(), want.values());
        }
    }
}

#[test]
fn another_device_learns_the_same_and_hands_it_back() {
    let _alone = alone_on_gpu();
    for algorithm in ["ddpg", "td3", "sac"] {
        for device in devices() {
            check_replica(algorithm, device);
        }
    }
}

/// Does the same as `--device cuda` on a device: updates by the graph, fetch, change on the host,
/// and more updates by the graph.
fn check_replica(algorithm: &str, device: Device) {
    let what = format!("{algorithm}, {:?}", device.location());
    let keys = [("algorithm.name", algorithm), ("algorithm.td3.actor_interval", "2")];
    let (mut here, mut there) = (case(&keys), case(&keys));
    there.algorithm.replica = Some(DeviceReplica::new(&there.config, device));
    let run = |case: &mut Case, updates: std::ops::RangeInclusive<u64>| {
        for update in updates {
            case.algorithm.update(&case.policy, &case.batch, update).unwrap();
        }
    };
    for case in [&mut here, &mut there] {
        run(case, 1..=20);
    }
    assert_fetched(&mut here, &mut there, &format!("{what}, 20 updates"));
    // Networks change on the host when the observation normalisation is updated.
    for case in [&mut here, &mut there] {
        case.algorithm.fetch().unwrap();
        let shrink = |_, network: &mut TrainableNetwork| {
            network.parameters.values_mut().iter_mut().for_each(|value| *value *= 0.9);
            Ok::<(), ()>(())
        };
        case.algorithm.for_each_network(shrink).unwrap();
        run(case, 21..=23);
    }
    assert_fetched(&mut here, &mut there, &format!("{what}, changed between"));
}

/// Candle's CPU takes both, a GPU neither.
#[test]
fn a_batch_on_the_device_has_no_empty_tensor_and_no_rows_with_gaps() {
    let cases = [
        case(&[("algorithm.name", "ddpg"), ("policy.kind", "mlp")]),
        case(&[("algorithm.name", "td3"), ("policy.kind", "chunk")]),
        case(&[("algorithm.name", "sac")]),
        case(&[("algorithm.name", "tqc"), ("policy.kind", "mlp")]),
        case_with_outcomes(&[("policy.start", "carry")]),
    ];
    for case in cases {
        let (shape, networks) = (case.algorithm.batch_shape(), case.algorithm.networks());
        let mut graph =
            Graph::new(&case.config, &case.policy, shape, &Device::Cpu, &networks).unwrap();
        graph.assert_fits_a_gpu(&case.policy, &case.batch);
    }
}

#[cfg(not(feature = "cuda"))]
#[test]
fn a_gpu_that_cannot_be_used_is_an_error_that_names_the_key() {
    let mut config = ExperimentConfig::default();
    config.learner.device = config::Device::Cuda;
    let policy = Policy::new(config.policy_description(&spec())).unwrap();
    let error = Algorithm::new(&config, &policy, None).unwrap_err().to_string();
    assert!(error.contains("learner.device = \"cuda\""), "{error}");
}

#[test]
fn the_switch_normalises_critics_and_no_other_network() {
    for algorithm in ["ddpg", "td3", "sac"] {
        for norm in ["false", "true"] {
            let keys = [("algorithm.name", algorithm), ("algorithm.critic_layer_norm", norm)];
            for (name, network) in case(&keys).algorithm.networks() {
                let want = norm == "true" && name.starts_with("critic");
                assert_eq!(network.layer_norm.is_some(), want, "{name} of {algorithm}");
                // Gain and shift for each of the 20 and 12 hidden units.
                let additional = network.parameters.values().len() - network.shape.parameters_len();
                assert_eq!(additional, if want { 64 } else { 0 }, "{name} of {algorithm}");
            }
        }
    }
}

#[test]
fn updates_fit_a_known_value_and_follow_its_gradient() {
    // Reward = 1 - |first action - 0.5|² without bootstrap, so Q is a paraboloid and the best first
    // action is 0.5 in both dimensions for every observation.
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
    let parameters = case.algorithm.networks()[0].1.parameters.values();
    case.policy.act(parameters, observations, &mut work);
    let errors = work.actions.iter().map(|u| (u - 0.5).abs());
    let mean = errors.sum::<f32>() / work.actions.len() as f32;
    assert!(mean < 0.05, "actions are {mean} away from the best on average");
}

/// A case whose critics see predicted outcomes.
fn case_with_outcomes(keys: &[(&str, &str)]) -> Case {
    let keys = [&[("algorithm.outcome_model", "true")], keys].concat();
    case_with(&keys, Some(GoalRule { goal_len: 2, desired: 2, ..goal_rule() }))
}

#[test]
fn updates_with_predicted_outcomes_are_those_of_the_graph() {
    for name in ["ddpg", "td3", "sac"] {
        for norm in ["false", "true"] {
            let keys = [("algorithm.name", name), ("algorithm.critic_layer_norm", norm)];
            let mut case = case_with_outcomes(&keys);
            assert_eq!(case.algorithm.networks().last().unwrap().0, "outcome_model");
            case.check(&format!("{name} with outcomes, layer normalisation {norm}"));
        }
    }
}

#[test]
fn the_number_of_threads_changes_no_bit_of_an_update() {
    let algorithms = ["ddpg", "td3", "sac"].into_iter();
    for (algorithm, norm) in algorithms.flat_map(|name| ["false", "true"].map(|norm| (name, norm)))
    {
        let run = |threads: &str| {
            let keys = [
                ("algorithm.name", algorithm),
                ("algorithm.critic_layer_norm", norm),
                ("learner.threads", threads),
                ("policy.hidden", "[256, 256]"),
                ("algorithm.critic_hidden", "[256, 256]"),
                ("algorithm.batch_size", "250"),
            ];
            let mut case = case_with_outcomes(&keys);
            for update in 1..=3 {
                case.algorithm.update(&case.policy, &case.batch, update).unwrap();
            }
            let networks = case.algorithm.networks().into_iter();
            let read = |network: &Parameters| network.values().to_vec();
            networks
                .map(|(_, t)| (read(&t.parameters), t.target.as_ref().map(read)))
                .collect::<Vec<_>>()
        };
        let one = run("1");
        assert!(one == run("2") && one == run("7"), "{algorithm} {norm}");
    }
}
