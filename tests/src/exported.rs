//! Exported policies of every kind, with the actions of the Rust runtime for a thousand
//! observations, as the reference for other runtimes.

#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::fs;
use std::path::{Path, PathBuf};

use dmprl_analysis::export;
use dmprl_runtime::PolicyRuntime;
use dmprl_shared::config::{ExperimentConfig, Layers, Limits, task_defaults};
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::policy::Policy;
use dmprl_shared::policy_file::OpenedPolicy;
use dmprl_shared::seeds;
use dmprl_shared::spec::EnvSpec;

/// Number of observations of each policy.
pub const OBSERVATIONS: usize = 1_000;

/// Angle at which a wrapped angle changes its sign.
const CORNERS: [f64; 4] = [0.0, -0.0, 1.0, -1.0];

type Keys = &'static [(&'static str, &'static str)];

/// Name, task, and configuration keys that differ from the task's defaults.
pub const KINDS: [(&str, &str, Keys); 15] = [
    ("dmp", "reacher", &[]),
    ("mlp", "pusher", &[("policy.kind", "mlp")]),
    ("sac-chunk", "pusher", &[("algorithm.name", "sac"), ("policy.kind", "chunk")]),
    ("sac-mlp", "reacher", &[("algorithm.name", "sac"), ("policy.kind", "mlp")]),
    (
        "sac-dmp",
        "pusher",
        &[("algorithm.name", "sac"), ("policy.segment_steps", "8"), ("policy.action_range", "0.6")],
    ),
    ("tqc-dmp", "reacher", &[("algorithm.name", "tqc")]),
    ("angles", "reacher", &[("policy.start", "observed"), ("policy.rho", "free")]),
    ("values", "panda-reach", &[("policy.start", "observed"), ("policy.execution", "segment")]),
    ("resting", "pusher", &[("policy.start", "observed"), ("policy.start_velocity", "zero")]),
    (
        "carry",
        "pusher",
        &[("policy.start", "carry"), ("exploration.warm_up_kind", "dmp_parameters")],
    ),
    (
        "action-segment",
        "pusher",
        &[
            ("policy.start", "action"),
            ("policy.controller", "direct"),
            ("policy.execution", "segment"),
        ],
    ),
    ("action", "pusher", &[("policy.start", "action"), ("policy.controller", "direct")]),
    ("action-chunk", "reacher", &[("policy.start", "action"), ("policy.kind", "chunk")]),
    ("action-mlp", "reacher", &[("policy.start", "action"), ("policy.kind", "mlp")]),
    (
        "ndp",
        "reacher",
        &[
            ("algorithm.name", "ndp"),
            ("policy.execution", "segment"),
            ("exploration.warm_up_steps", "0"),
            ("algorithm.action_rate_penalty", "0.0"),
            ("policy.controller", "position"),
            ("policy.start", "observed"),
            ("policy.position_scale", "3.0"),
            ("dmp.forcing_scaling", "goal"),
            ("dmp.integrator", "explicit"),
        ],
    ),
];

/// Writes for each kind, into a folder of its name, `policy.safetensors`, `policy.onnx`,
/// `observations.f64` of shape (n, O), and `segments.f64` of shape (n, K, A), the results of
/// [`PolicyRuntime::segment`].
///
/// # Panics
/// If a file cannot be written.
pub fn write(folder: &Path) {
    for (name, task, keys) in KINDS {
        let folder = folder.join(name);
        fs::create_dir(&folder).unwrap();
        let opened = policy(task, keys);
        let file = folder.join("policy.safetensors");
        fs::write(&file, export::safetensors(&opened).unwrap()).unwrap();
        fs::write(folder.join("policy.onnx"), export::onnx(&opened).unwrap()).unwrap();
        let mut runtime = PolicyRuntime::load(&file).unwrap();
        let len = runtime.spec().observation_len;
        // Numbers that f32 represents exactly, so that each runtime gets the same.
        let mut observations: Vec<f64> =
            (0..OBSERVATIONS * len).map(|i| f64::from(1.5 * (i as f32 * 1.7).sin())).collect();
        // Zeros of both signs, in every combination with other numbers.
        for (row, observation) in observations.chunks_mut(len).take(4 * CORNERS.len()).enumerate() {
            for (i, value) in observation.iter_mut().enumerate() {
                *value = CORNERS[(row + i * (1 + row / CORNERS.len())) % CORNERS.len()];
            }
        }
        let mut segments = Vec::new();
        for observation in observations.chunks(len) {
            segments.extend_from_slice(runtime.segment(observation).unwrap());
        }
        write_numbers(&folder.join("observations.f64"), &observations);
        write_numbers(&folder.join("segments.f64"), &segments);
    }
}

/// Returns a policy with random, large parameters.
///
/// # Panics
/// If the keys are invalid.
#[must_use]
pub fn policy(task: &str, keys: &[(&str, &str)]) -> OpenedPolicy {
    let mut layers = Layers::new();
    layers.add(task, task_defaults(task).unwrap().table()).unwrap();
    for (key, value) in keys {
        layers.set("test", key, value).unwrap();
    }
    let config: ExperimentConfig = layers.finish().unwrap().resolve(Limits { cores: 2 }).unwrap();
    let policy = Policy::new(config.policy_description(&spec(task))).unwrap();
    let mut values = policy.initial_parameters(&mut seeds::stream(1, "test", 0));
    // Initial networks hardly leave the middle of the tanh.
    values.iter_mut().for_each(|value| *value *= 2.0);
    let architecture_hash = policy.architecture_hash();
    let snapshot =
        ParameterSnapshot { version: 7, env_steps: 100, architecture_hash, settled: false, values };
    OpenedPolicy { policy, snapshot, origin: None, hold: None }
}

/// Asymmetric bounds: scaling must use both.
fn spec(task: &str) -> EnvSpec {
    let task = task_defaults(task).unwrap();
    let bounds = vec![(-1.0, 3.0); task.action_low.len()];
    EnvSpec::new("Test-v0", task.observation_len, &bounds, 0.02, 50)
}

/// Writes numbers in little-endian order.
///
/// # Panics
/// If the file cannot be written.
pub fn write_numbers(path: &Path, numbers: &[f64]) {
    let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
    fs::write(path, bytes).unwrap();
}

/// Reads the numbers that [`write_numbers`] wrote.
///
/// # Panics
/// If the file cannot be read.
#[must_use]
pub fn read_numbers(path: &Path) -> Vec<f64> {
    let bytes = fs::read(PathBuf::from(path)).unwrap();
    bytes.chunks_exact(8).map(|eight| f64::from_le_bytes(eight.try_into().unwrap())).collect()
}
