//! Compares the NumPy policy of the benchmark's peers with the Rust policy.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::path::Path;
use std::process::Command;

use dmprl_bench::{Controls, NumpyPlan};
use dmprl_shared::config::{ExperimentConfig, Layers, Limits, task_defaults};
use dmprl_shared::policy::Policy;
use dmprl_shared::seeds;
use dmprl_shared::spec::EnvSpec;
use dmprl_tests::{project_root, venv};

const ROWS: usize = 7;
/// Both compute in f32 and sum in different orders.
const TOLERANCE: f32 = 1e-5;

/// Reads the plan and observations as the policy sees them; writes u, then actions, as f32.
const ACT: &str = "
import json, sys
import numpy as np
from dmprl.numpy_policy import NumpyPolicy
plan = json.load(open(sys.argv[1]))
policy = NumpyPolicy(plan)
seen = np.fromfile(sys.argv[2], '<f4').reshape(policy.env_count, -1)
env_len = plan['spec']['observation_len']
policy.state[:] = seen[:, env_len:]
u = policy.u(seen[:, :env_len])
u.astype('<f4').tofile(sys.argv[3])
policy.scaled(u).astype('<f4').tofile(sys.argv[4])
";

fn config(task: &str, keys: &[(&str, &str)]) -> ExperimentConfig {
    let mut layers = Layers::new();
    layers.add(task, task_defaults(task).unwrap().table()).unwrap();
    for (key, value) in keys {
        layers.set("test", key, value).unwrap();
    }
    layers.set("test", "actors.envs_per_worker", &ROWS.to_string()).unwrap();
    layers.finish().unwrap().resolve(Limits { cores: 2 }).unwrap()
}

/// Asymmetric bounds: scaling must use both.
fn spec(task: &str) -> EnvSpec {
    let task = task_defaults(task).unwrap();
    let bounds = vec![(-1.0, 3.0); task.action_low.len()];
    EnvSpec::new("Test-v0", task.observation_len, &bounds, 0.02, 50)
}

fn read(path: &Path) -> Vec<f32> {
    let bytes = std::fs::read(path).unwrap();
    bytes.chunks_exact(4).map(|four| f32::from_le_bytes(four.try_into().unwrap())).collect()
}

fn assert_near(got: &[f32], expected: &[f32], what: &str) {
    assert_eq!(got.len(), expected.len(), "{what}");
    let pairs = got.iter().zip(expected);
    let largest = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(largest <= TOLERANCE, "{what}: off by {largest}, at most {TOLERANCE}");
}

fn assert_same(task: &str, keys: &[(&str, &str)]) {
    let (config, spec) = (config(task, keys), spec(task));
    let policy = Policy::new(config.policy_description(&spec)).unwrap();
    let mut parameters = policy.initial_parameters(&mut seeds::stream(1, "test", 0));
    // Initial networks hardly leave the middle of the tanh.
    parameters.iter_mut().for_each(|parameter| *parameter *= 3.0);
    let len = ROWS * policy.layout().observation_len;
    let observations: Vec<f32> = (0..len).map(|index| 1.5 * (index as f32 * 1.7).sin()).collect();
    let mut work = policy.workspace(ROWS);
    policy.act(&parameters, &observations, &mut work);
    let spread = work.actions.iter().fold(0.0_f32, |largest, u| largest.max(u.abs()));
    assert!(spread > 0.1, "{keys:?}: actions of nothing compare nothing");
    let mut scaled = vec![0.0; work.actions.len()];
    policy.scaling().apply(&work.actions, &mut scaled);
    let scaled: Vec<f32> = scaled.into_iter().map(|action| action as f32).collect();

    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let controls = Controls::Policy;
    let plan =
        NumpyPlan::write(folder.path(), &config, &spec, controls, &policy, &parameters).unwrap();
    let bytes: Vec<u8> = observations.iter().flat_map(|value| value.to_le_bytes()).collect();
    std::fs::write(path("observations"), bytes).unwrap();
    let output = Command::new(&venv().executable)
        .args(["-c", ACT])
        .arg(plan)
        .args(["observations", "u", "actions"].map(path))
        .current_dir(project_root())
        .output()
        .unwrap();
    assert!(output.status.success(), "{keys:?}: {}", String::from_utf8_lossy(&output.stderr));
    assert_near(&read(&path("u")), &work.actions, &format!("{task} {keys:?}: u"));
    assert_near(&read(&path("actions")), &scaled, &format!("{task} {keys:?}: actions"));
}

#[test]
fn a_network_that_decides_every_step_acts_the_same() {
    assert_same("reacher", &[("policy.kind", "mlp")]);
    assert_same("reacher", &[("policy.kind", "chunk")]);
}

#[test]
fn the_mean_of_a_squashed_gaussian_acts_the_same() {
    assert_same("reacher", &[("algorithm.name", "sac"), ("policy.kind", "mlp")]);
    assert_same("pusher", &[("algorithm.name", "sac")]);
    assert_same("reacher", &[("algorithm.name", "tqc")]);
}

#[test]
fn movement_primitives_act_the_same() {
    assert_same("reacher", &[]);
    assert_same("pusher", &[("policy.segment_steps", "8"), ("policy.action_range", "0.6")]);
}

#[test]
fn movement_primitives_of_other_kinds_act_the_same() {
    assert_same("reacher", &[("policy.start", "observed"), ("policy.rho", "free")]);
    assert_same("pusher", &[("policy.start", "observed"), ("policy.start_velocity", "zero")]);
    // Its positions are goal minus position.
    assert_same("panda-reach", &[("policy.start", "observed")]);
    let drawn = ("exploration.warm_up_kind", "dmp_parameters");
    assert_same("pusher", &[drawn, ("policy.start", "carry")]);
    assert_same("pusher", &[("policy.start", "action"), ("policy.controller", "direct")]);
    assert_same("reacher", &[("dmp.forcing_scaling", "goal"), ("dmp.integrator", "explicit")]);
    let stochastic = [
        ("algorithm.name", "ndp"),
        ("exploration.warm_up_steps", "0"),
        ("algorithm.action_rate_penalty", "0.0"),
        ("policy.controller", "position"),
        ("policy.position_scale", "3.0"),
    ];
    assert_same("reacher", &stochastic);
}
