//! Peers of the learner: the same update in PyTorch and JAX (`tests/peers/learner_peer.py`).

use std::fs::File;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use clap::ValueEnum;
use dmprl_run::Watch;
use dmprl_shared::config::{Controller, ExperimentConfig, RhoKind};
use dmprl_shared::spec::EnvSpec;
use serde::Deserialize;
use serde_json::{Value, json};

use super::LearnerBench;
use super::figures::Timed;
use crate::child::LineChild;

/// Time limit until a peer is ready. Importing PyTorch from a cold disk alone takes half a minute.
const READY: Duration = Duration::from_secs(300);
/// Time beyond a measurement's duration until it times out. The first one includes compilation.
const MEASURE_SLACK: Duration = Duration::from_secs(120);

/// A library that does the same update.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub enum PeerKind {
    /// PyTorch, eager.
    Torch,
    /// PyTorch, compiled.
    TorchCompile,
    /// JAX, compiled.
    Jax,
}

impl PeerKind {
    /// All peers, in the order of the report.
    pub(super) const ALL: [Self; 3] = [Self::Torch, Self::TorchCompile, Self::Jax];

    /// Name of the peer in the script.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Torch => "torch",
            Self::TorchCompile => "torch-compile",
            Self::Jax => "jax",
        }
    }
}

/// A peer's process.
pub(super) struct Peer {
    pub(super) kind: PeerKind,
    child: LineChild,
}

#[derive(Debug, Deserialize)]
struct Measured {
    updates: u64,
    seconds: f64,
    cpu_s: f64,
}

impl Peer {
    /// Starts the process without waiting for it.
    pub(super) fn start(
        kind: PeerKind,
        bench: &LearnerBench,
        folder: &Path,
    ) -> anyhow::Result<Self> {
        if let Some(why) = unsupported(&bench.config) {
            bail!("{}", why);
        }
        // A file of its own: the next peer's must not be written while this one reads.
        let settings = folder.join(format!("{}.json", kind.name()));
        std::fs::write(&settings, settings_of(&bench.config, &bench.spec).to_string())
            .with_context(|| format!("cannot write {}", settings.display()))?;
        let log_path = folder.join(format!("{}.log", kind.name()));
        let log = File::create(&log_path)
            .with_context(|| format!("cannot make {}", log_path.display()))?;
        let mut command = Command::new(&bench.peer_python);
        command
            .arg(bench.peers_path.join("learner_peer.py"))
            .arg(kind.name())
            .arg("--settings")
            .arg(&settings)
            .args(["--threads", &bench.config.learner.threads.to_string()])
            .current_dir(folder)
            // Prevents Python from writing next to the sources.
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .stderr(log);
        let child = LineChild::start(kind.name().to_owned(), command, &log_path)?;
        Ok(Self { kind, child })
    }

    /// Waits until the peer is ready. Returns its description, or the reason why it is unavailable.
    pub(super) fn ready(&mut self, watch: &Watch) -> anyhow::Result<Result<String, String>> {
        self.child.greeting(watch, READY)
    }

    /// Measures the time of one update.
    pub(super) fn measure(&mut self, watch: &Watch, duration: Duration) -> anyhow::Result<Timed> {
        self.child.send_line(&format!("run {}", duration.as_secs_f64()))?;
        let line = self.child.next_line(watch, duration + MEASURE_SLACK, "the measurement")?;
        let Ok(Measured { updates, seconds, cpu_s }) = serde_json::from_str(&line) else {
            return Err(self.child.unexpected_line(&line));
        };
        let name = self.kind.name();
        ensure!(updates > 0 && seconds > 0.0, "{name}: {updates} updates in {seconds} s");
        let updates = updates as f64;
        Ok(Timed { wall_s: seconds / updates, cpu_s: cpu_s / updates })
    }
}

/// Returns the reason why the script cannot do this configuration's update, if any.
fn unsupported(config: &ExperimentConfig) -> Option<&'static str> {
    let algorithm = &config.algorithm;
    let differences = [
        (algorithm.critic_layer_norm, "tests/peers has no layer normalisation"),
        (
            algorithm.td3.actor_interval != 2,
            "tests/peers updates TD3's actor at every second update",
        ),
        (config.policy.rho == RhoKind::Free, "tests/peers has only a bounded rho"),
        (config.policy.follows_actions(), "tests/peers has no policy.start = \"action\""),
        (
            config.policy.controller == Controller::Direct,
            "tests/peers has no policy.controller = \"direct\"",
        ),
        (
            algorithm.action_rate_penalty
                + algorithm.action_acceleration_penalty
                + algorithm.saturation_penalty
                + algorithm.jerk_cost
                > 0.0,
            "tests/peers has no algorithm.action_rate_penalty, action_acceleration_penalty, \
             saturation_penalty or jerk_cost",
        ),
    ];
    differences.into_iter().find_map(|(differs, why)| differs.then_some(why))
}

/// Returns the `Settings` of `tests/golden/update/settings.py`: sizes, and everything else that
/// changes the amount of work.
fn settings_of(config: &ExperimentConfig, spec: &EnvSpec) -> Value {
    let (algorithm, policy, dmp) = (&config.algorithm, &config.policy, &config.dmp);
    json!({
        "algorithm": algorithm.name,
        "policy": policy.kind,
        "observation_len": spec.observation_len,
        "action_len": spec.action_len,
        "control_dt_s": spec.control_dt_s,
        "start_sources": config.task.start_sources,
        "batch_size": algorithm.batch_size,
        "hidden": policy.hidden,
        "critic_hidden": algorithm.critic_hidden,
        "segment_steps": policy.segment_steps,
        "critic": algorithm.critic,
        "start": policy.start,
        "start_velocity": policy.start_velocity,
        "goal_range": policy.goal_range,
        "weight_range": policy.weight_range,
        "rho_range": policy.rho_range,
        "basis_count": dmp.basis_count,
        "alpha_x": dmp.alpha_x,
        "alpha_y": dmp.alpha_y,
        "integration_steps": dmp.integration_steps,
        "integrator": dmp.integrator,
        "forcing_scaling": dmp.forcing_scaling,
        "critic_learning_rate": algorithm.critic_learning_rate,
        "actor_learning_rate": algorithm.actor_learning_rate,
        "polyak": algorithm.polyak,
    })
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Layers;

    use super::*;

    #[test]
    fn peers_reject_configurations_with_another_update() {
        let with = |key: &str, value: &str| {
            let mut layers = Layers::new();
            layers.set("test", "algorithm.action_rate_penalty", "0.0").unwrap();
            layers.set("test", key, value).unwrap();
            unsupported(&layers.finish().unwrap())
        };
        assert_eq!(with("algorithm.batch_size", "64"), None);
        for (key, value) in [
            ("algorithm.critic_layer_norm", "true"),
            ("algorithm.td3.actor_interval", "3"),
            ("policy.rho", "free"),
            ("algorithm.action_rate_penalty", "0.2"),
            ("algorithm.action_acceleration_penalty", "0.2"),
            ("algorithm.saturation_penalty", "0.2"),
            ("policy.start", "action"),
            ("policy.controller", "direct"),
        ] {
            assert!(with(key, value).is_some(), "{key}");
        }
    }
}
