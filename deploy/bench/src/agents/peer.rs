//! One training by another library.

use std::fs::File;
use std::path::Path;
use std::process::Command;

use anyhow::Context;
use clap::ValueEnum;
use dmprl_run::Watch;
use dmprl_shared::config::{ExperimentConfig, PolicyKind};
use serde::Deserialize;
use serde_json::{Value, json};

use super::{AgentsBench, Evaluated, Target, Training, limit};
use crate::child::LineChild;

/// An algorithm of another library.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub enum AgentKind {
    /// TD3 of Stable-Baselines3 (PyTorch).
    Sb3Td3,
    /// SAC of Stable-Baselines3 (PyTorch).
    Sb3Sac,
    /// TD3 of SBX (JAX).
    SbxTd3,
    /// SAC of SBX (JAX).
    SbxSac,
    /// CrossQ of SBX (JAX).
    SbxCrossq,
    /// SAC of SBX (JAX) with SimBa's networks.
    SbxSimba,
    /// TQC of SB3-Contrib (PyTorch).
    Sb3Tqc,
    /// TQC with hindsight of SB3-Contrib (PyTorch), for tasks with goals; the RL Zoo's settings for
    /// those that move an object.
    Sb3TqcHer,
}

impl AgentKind {
    /// Name in the script, on the command line and in reports.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Sb3Td3 => "sb3-td3",
            Self::Sb3Sac => "sb3-sac",
            Self::SbxTd3 => "sbx-td3",
            Self::SbxSac => "sbx-sac",
            Self::SbxCrossq => "sbx-crossq",
            Self::SbxSimba => "sbx-simba",
            Self::Sb3Tqc => "sb3-tqc",
            Self::Sb3TqcHer => "sb3-tqc-her",
        }
    }
}

/// A line of the script: the state at an evaluation, or at the end.
#[derive(Debug, Deserialize)]
struct State {
    ended: bool,
    env_steps: u64,
    evaluated: Option<Evaluated>,
    start_s: f64,
    evaluation_s: f64,
}

/// Trains in the new folder `place`. Returns the peer's description and the result, or the reason
/// why the peer is unavailable or failed.
pub(super) fn train(
    kind: AgentKind,
    bench: &AgentsBench,
    config: &ExperimentConfig,
    place: &Path,
    watch: &Watch,
) -> anyhow::Result<Result<(String, Training), String>> {
    std::fs::create_dir(place).with_context(|| format!("cannot make {}", place.display()))?;
    let (settings, log) = (place.join("settings.json"), place.join("log"));
    std::fs::write(&settings, settings_of(config, bench.equal_settings).to_string())
        .with_context(|| format!("cannot write {}", settings.display()))?;
    let errors = File::create(&log).with_context(|| format!("cannot make {}", log.display()))?;
    let mut command = Command::new(&bench.peer_python);
    command
        .arg(bench.peers_path.join("agent_peer.py"))
        .args([kind.name(), "--settings"])
        .arg(&settings)
        .arg("--package")
        .arg(&bench.package_path)
        .current_dir(place)
        // Prevents Python from writing next to the sources.
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .stderr(errors);
    let mut child = LineChild::start(kind.name().to_owned(), command, &log)?;
    let about = match child.greeting(watch, limit(config))? {
        Ok(about) => about,
        Err(why) => return Ok(Err(why)),
    };
    loop {
        let next = child.next_line_if_any(watch, limit(config), "the next evaluation")?;
        let Some(line) = next else { return Ok(Err(child.exit_summary())) };
        let seconds = child.started().elapsed().as_secs_f64();
        let Ok(state) = serde_json::from_str::<State>(&line) else {
            return Err(child.unexpected_line(&line));
        };
        if state.ended {
            let target = Target::of(config);
            let training = Training {
                reached: state.evaluated.is_some_and(|it| target.is_reached(&it)),
                seconds,
                start_s: Some(state.start_s),
                evaluation_s: state.evaluation_s,
                env_steps: state.env_steps,
                evaluated: state.evaluated,
            };
            return Ok(Ok((about, training)));
        }
    }
}

fn settings_of(config: &ExperimentConfig, equal: bool) -> Value {
    let target = match Target::of(config) {
        Target::Return(value) => json!({ "of": "return_mean", "value": value }),
        Target::Success(value) => json!({ "of": "success_rate", "value": value }),
        Target::None => Value::Null,
    };
    json!({
        "task": config.task.id,
        "options": config.task.options_toml(),
        "python_path": config.task.python_path,
        "seed": config.run.seed,
        "steps": config.run.steps,
        "seconds_max": config.run.max_minutes * 60.0,
        "learning_starts": config.exploration.warm_up_steps,
        "evaluation_interval": config.evaluation.interval_steps,
        "episodes": config.evaluation.episodes,
        "first_seed": config.evaluation.first_seed,
        "target": target,
        "algorithm": equal.then(|| algorithm_of(config)),
    })
}

/// Our settings, for any algorithm of a peer. A peer has one learning rate; it gets that of our
/// critics. It decides at every step, so it gets the updates of a segment after as many steps.
fn algorithm_of(config: &ExperimentConfig) -> Value {
    let algorithm = &config.algorithm;
    let steps = match config.policy.kind {
        PolicyKind::Mlp => 1,
        PolicyKind::Dmp | PolicyKind::Chunk => config.policy.segment_steps,
    };
    json!({
        "hidden": config.policy.hidden,
        "critic_hidden": algorithm.critic_hidden,
        "batch_size": algorithm.batch_size,
        "learning_rate": algorithm.critic_learning_rate,
        "discount": algorithm.discount,
        "polyak": algorithm.polyak,
        "steps": steps,
        "updates": config.pacing.updates_per_segment.round().max(1.0) as u64,
    })
}
