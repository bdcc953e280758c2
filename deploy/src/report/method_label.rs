//! Names the method of a run, in reports and on the dashboard.

use dmprl_shared::config::{AlgorithmName, ExperimentConfig, PRESETS, PolicyKind};

/// Returns the label of a run that belongs to no sweep, such as `TD3-DMP` or `DDPG-DMP (paper)`.
/// A preset other than the default is part of the label, because runs with different presets are
/// not seeds of one method.
pub(crate) fn method_label(config: &ExperimentConfig, preset: Option<&str>) -> String {
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
        // Its policy is always a movement primitive.
        AlgorithmName::Ndp => return "NDP".to_owned(),
    };
    match config.policy.kind {
        PolicyKind::Dmp => format!("{algorithm}-DMP"),
        PolicyKind::Mlp => algorithm.to_owned(),
    }
}
