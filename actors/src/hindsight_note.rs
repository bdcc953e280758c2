//! The line that a worker prints about hindsight at its start.

use dmprl_shared::config::{CriticInput, ExperimentConfig};
use dmprl_shared::goal_rule::{GoalReward, GoalRule};

/// The source of an environment's rewards for goals.
#[derive(Debug, Clone, Copy)]
pub(crate) enum GoalRewards<'a> {
    /// Hindsight is off. The environment may have no goals.
    NoHindsight {
        /// Whether the reward only depends on whether the goal is reached.
        is_sparse: bool,
    },
    /// The reward follows no known rule, for this reason.
    NoRule(&'a str),
    /// The reward follows this rule.
    Rule(&'a GoalRule),
}

/// Says where hindsight takes its rewards from, and which settings have no effect. Without
/// hindsight, suggests it if the reward is sparse, because random exploration rarely reaches the
/// goal.
pub(crate) fn hindsight_note(
    config: &ExperimentConfig,
    rewards: GoalRewards<'_>,
) -> Option<String> {
    let (note, idle) = match rewards {
        GoalRewards::Rule(GoalRule { reward: GoalReward::Sparse { threshold, .. }, .. }) => (
            Some(format!(
                "hindsight draws goals for each batch; a goal is reached within {threshold} of it"
            )),
            settings_for_segment_critics(config),
        ),
        GoalRewards::Rule(_) => (
            Some("hindsight draws goals for each batch, with rewards by distance".to_owned()),
            idle_settings(config, "with a dense reward", true),
        ),
        GoalRewards::NoRule(reason) => (
            Some(format!(
                "hindsight: workers make copies, because the reward follows no known rule: {reason}"
            )),
            idle_settings(config, "without a rule (docs/environments.md, Rules)", false),
        ),
        GoalRewards::NoHindsight { is_sparse } => (
            is_sparse.then(|| {
                "the reward is sparse: it only depends on whether the goal is reached. With \
                 --preset goal (or --set replay.hindsight=future) the run also learns from goals \
                 reached by chance"
                    .to_owned()
            }),
            idle_settings(config, "without hindsight", false),
        ),
    };
    let parts: Vec<String> = note.into_iter().chain(idle).collect();
    (!parts.is_empty()).then(|| parts.join("; "))
}

/// Names the settings that are set and need critics of whole segments, if the critics see only the
/// first action.
fn settings_for_segment_critics(config: &ExperimentConfig) -> Option<String> {
    let algorithm = &config.algorithm;
    let settings = [
        ("algorithm.imitation_penalty", algorithm.imitation_penalty > 0.0),
        ("algorithm.outcome_model", algorithm.outcome_model),
    ];
    let condition = "with algorithm.critic = \"first\"";
    (algorithm.critic == CriticInput::First).then(|| no_effect(condition, &settings)).flatten()
}

/// Names the settings that are set and have no effect under a condition: all that need a rule for
/// goals, or with `only_sparse` only those that need a sparse one.
fn idle_settings(config: &ExperimentConfig, condition: &str, only_sparse: bool) -> Option<String> {
    let ExperimentConfig { algorithm, replay, .. } = config;
    let settings = [
        ("algorithm.imitation_penalty", algorithm.imitation_penalty > 0.0),
        ("algorithm.motion_bonus", algorithm.motion_bonus > 0.0),
        ("algorithm.outcome_model", algorithm.outcome_model),
        ("replay.moved_share", replay.moved_share > 0.0),
        ("replay.other_goals_share", !only_sparse && replay.other_goals_share > 0.0),
        ("replay.near_misses_share", !only_sparse && replay.near_misses_share > 0.0),
    ];
    no_effect(condition, &settings)
}

/// Says that those of the settings that are set have no effect.
fn no_effect(condition: &str, settings: &[(&str, bool)]) -> Option<String> {
    let names: Vec<&str> =
        settings.iter().filter(|(_, is_set)| *is_set).map(|(name, _)| *name).collect();
    (!names.is_empty()).then(|| format!("no effect {condition}: {}", names.join(", ")))
}

#[cfg(test)]
mod tests {
    use dmprl_shared::goal_rule::Norm;

    use super::*;

    fn with_goal_settings() -> ExperimentConfig {
        let mut config = ExperimentConfig::default();
        config.algorithm.imitation_penalty = 0.1;
        config.algorithm.outcome_model = true;
        config.replay.near_misses_share = 0.4;
        config
    }

    fn rule(reward: GoalReward) -> GoalRule {
        GoalRule {
            achieved: 0,
            desired: 1,
            goal_len: 1,
            components: vec![0],
            norm: Norm::Euclidean,
            reward,
            ends_within: None,
        }
    }

    #[test]
    fn settings_without_effect_are_named() {
        let config = with_goal_settings();
        let dense = rule(GoalReward::Dense { factor: -1.0 });
        let no_rule = GoalRewards::NoRule("it is 3");
        let [plain, sparse] = [false, true].map(|is_sparse| GoalRewards::NoHindsight { is_sparse });
        for (rewards, expected) in [
            (plain, "no effect without hindsight: algorithm.imitation_penalty, "),
            (sparse, "--preset goal"),
            (sparse, "; no effect without hindsight: algorithm.imitation_penalty"),
            (no_rule, "no known rule: it is 3; no effect without a rule"),
            (no_rule, "algorithm.outcome_model, replay.near_misses_share"),
            (GoalRewards::Rule(&dense), "with a dense reward: algorithm.imitation_penalty, "),
        ] {
            let note = hindsight_note(&config, rewards).unwrap();
            assert!(note.contains(expected), "{note}\nexpected: {expected}");
        }
        let note = hindsight_note(&config, GoalRewards::Rule(&dense)).unwrap();
        assert!(!note.contains("near_misses"), "{note}");
    }

    #[test]
    fn settings_for_critics_of_whole_segments_are_named() {
        let mut config = with_goal_settings();
        config.algorithm.critic = CriticInput::First;
        let sparse = rule(GoalReward::Sparse { threshold: 0.05, reached: 0.0, missed: -1.0 });
        let note = hindsight_note(&config, GoalRewards::Rule(&sparse)).unwrap();
        let expected = "; no effect with algorithm.critic = \"first\": \
                        algorithm.imitation_penalty, algorithm.outcome_model";
        assert!(note.ends_with(expected), "{note}");
    }

    #[test]
    fn settings_that_have_an_effect_are_not_named() {
        let config = ExperimentConfig::default();
        assert_eq!(hindsight_note(&config, GoalRewards::NoHindsight { is_sparse: false }), None);
        let sparse = rule(GoalReward::Sparse { threshold: 0.05, reached: 0.0, missed: -1.0 });
        let note = hindsight_note(&with_goal_settings(), GoalRewards::Rule(&sparse)).unwrap();
        assert_eq!(
            note,
            "hindsight draws goals for each batch; a goal is reached within 0.05 of it"
        );
    }
}
