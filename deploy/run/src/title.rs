//! Names of a run and its method, for the terminal, reports and the dashboard.

use dmprl_shared::config::{AlgorithmName, ExperimentConfig, PRESETS, PolicyKind};

/// Describes a run in one line.
#[must_use]
pub fn title(config: &ExperimentConfig) -> String {
    let policy = config.policy.kind.name();
    let algorithm = config.algorithm.name.name();
    let actors = &config.actors;
    let count =
        |count: usize, what: &str| format!("{count} {what}{}", if count == 1 { "" } else { "s" });
    let process = if config.run.deterministic { "one process, " } else { "" };
    let workers = count(actors.workers, "worker");
    let environments = count(actors.envs_per_worker, "environment");
    let (task, seed) = (&config.task.name, config.run.seed);
    format!("{task} · {algorithm} · {policy} · seed {seed} · {process}{workers} × {environments}")
}

/// Returns the label of a run that belongs to no sweep, such as `TD3-DMP` or `DDPG-DMP (paper)`.
/// A preset other than the default is part of the label, because runs with different presets are
/// not seeds of one method.
#[must_use]
pub fn method_label(config: &ExperimentConfig, preset: Option<&str>) -> String {
    let method = method(config);
    match preset.filter(|&name| name != PRESETS[0].name) {
        Some(name) => format!("{method} ({name})"),
        None => method,
    }
}

fn method(config: &ExperimentConfig) -> String {
    let algorithm = match config.algorithm.name {
        AlgorithmName::Ddpg => "DDPG",
        AlgorithmName::Td3 => "TD3",
        AlgorithmName::Sac => "SAC",
        AlgorithmName::Tqc => "TQC",
        // Its policy is always a DMP.
        AlgorithmName::Ndp => return "NDP".to_owned(),
    };
    match config.policy.kind {
        PolicyKind::Dmp => format!("{algorithm}-DMP"),
        PolicyKind::Mlp => algorithm.to_owned(),
        PolicyKind::Chunk => format!("{algorithm}-chunk"),
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Limits;

    use super::*;

    #[test]
    fn a_deterministic_run_has_one_worker_regardless_of_the_configuration() {
        let mut config = ExperimentConfig::default();
        (config.actors.workers, config.run.deterministic) = (4, true);
        let config = config.resolve(Limits { cores: 8 }).unwrap();
        assert!(title(&config).ends_with("one process, 1 worker × 8 environments"));
    }
}
