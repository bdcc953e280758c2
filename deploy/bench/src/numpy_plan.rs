//! The plan from which Python peers do the same work as the workers
//! (`envs_py/dmprl/numpy_policy.py`).

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::ValueEnum;
use dmprl_shared::config::{
    DmpConfig, ExperimentConfig, ExplorationConfig, PolicyConfig, PolicyKind, TaskConfig,
};
use dmprl_shared::dmp::{Dmp, SegmentMap};
use dmprl_shared::policy::Policy;
use dmprl_shared::spec::EnvSpec;
use serde::Serialize;

/// Controls for the benchmark of physics alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Controls {
    /// Actions of the policy, with its exploration noise.
    Policy,
    /// Actions drawn uniformly within their bounds.
    Random,
}

/// A task, its environments and a policy with its parameters, written as one JSON object.
#[derive(Debug, Serialize)]
pub struct NumpyPlan<'a> {
    task: &'a TaskConfig,
    /// The task's arguments and wrappers as TOML, because JSON has no infinity.
    options: String,
    policy: &'a PolicyConfig,
    dmp: &'a DmpConfig,
    exploration: &'a ExplorationConfig,
    spec: &'a EnvSpec,
    seed: u64,
    env_count: usize,
    /// Source of the actions for the benchmark of physics alone.
    controls: Controls,
    /// Environment steps per decision.
    decision_steps: usize,
    /// Widths of the network, from input to output.
    widths: Vec<usize>,
    /// Linear map from (y0, yd0, g, w) to the samples of one dimension, (3K, 3+N). Empty without a
    /// DMP.
    segment_map: Vec<f32>,
    /// Standard deviations of the policy's own Gaussian, (A,). Empty if it has none.
    gaussian_std: Vec<f32>,
    /// Number of the network's last outputs that are logarithmic standard deviations: K A or 0.
    log_stds_len: usize,
    /// File with the network's flat parameters, 32-bit little-endian.
    parameters: PathBuf,
}

impl<'a> NumpyPlan<'a> {
    /// Writes the parameters and the plan, which refers to them, into `folder`. Returns the plan's
    /// path.
    ///
    /// # Errors
    /// The DMP is invalid, or a file cannot be written.
    pub fn write(
        folder: &Path,
        config: &'a ExperimentConfig,
        spec: &'a EnvSpec,
        controls: Controls,
        policy: &Policy,
        parameters: &[f32],
    ) -> anyhow::Result<PathBuf> {
        let shape = policy.shape();
        let widths = std::iter::once(shape.inputs());
        let parameters_path = folder.join("parameters.f32");
        let log_std = policy.learned_std().map_or(&[][..], |learned| learned.log_std(parameters));
        let plan = Self {
            task: &config.task,
            options: config.task.options_toml(),
            policy: &config.policy,
            dmp: &config.dmp,
            exploration: &config.exploration,
            spec,
            seed: config.run.seed,
            env_count: config.actors.envs_per_worker,
            controls,
            decision_steps: config.policy.decision_steps(),
            widths: widths.chain(shape.layers().iter().map(|layer| layer.outputs)).collect(),
            segment_map: segment_map(config)?,
            gaussian_std: log_std.iter().map(|log_std| log_std.exp()).collect(),
            log_stds_len: policy.log_stds().map_or(0, |columns| columns.len()),
            parameters: parameters_path.clone(),
        };
        let network = &parameters[..shape.parameters_len()];
        let bytes: Vec<u8> = network.iter().flat_map(|value| value.to_le_bytes()).collect();
        let text = serde_json::to_vec(&plan).context("cannot write the plan as JSON")?;
        let path = folder.join("plan.json");
        for (path, bytes) in [(&parameters_path, bytes), (&path, text)] {
            std::fs::write(path, bytes)
                .with_context(|| format!("cannot write {}", path.display()))?;
        }
        Ok(path)
    }
}

fn segment_map(config: &ExperimentConfig) -> anyhow::Result<Vec<f32>> {
    if config.policy.kind != PolicyKind::Dmp {
        return Ok(Vec::new());
    }
    let dmp = Dmp::new(&config.dmp, config.policy.segment_steps)?;
    let weight_scale = config.policy.weight_range * dmp.omega() * dmp.omega();
    Ok(SegmentMap::new(&dmp, weight_scale).matrix().to_vec())
}
