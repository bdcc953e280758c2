//! Presets: named sets of values, which override the task defaults and yield to the user's file.

use toml::Table;

use super::{AlgorithmName, PolicyKind, task_defaults};

/// A preset: its name, a one-line description, and its values as TOML.
#[derive(Debug)]
pub struct Preset {
    /// The name for `--preset`.
    pub name: &'static str,
    /// One-line description.
    pub about: &'static str,
    text: &'static str,
}

/// All presets, in the order of `--help`.
pub const PRESETS: [Preset; 4] = [
    Preset {
        name: "default",
        about: "segment critic, sliding windows, n-step target: best in our measurements",
        text: "",
    },
    Preset {
        name: "paper",
        about: "our reading of the paper: first-action critic, literal target, values of Table 2",
        text: PAPER,
    },
    Preset {
        name: "fast",
        about: "least wall time: frequent evaluations, so that --until-return and \
                --until-success stop the run early",
        text: FAST,
    },
    Preset {
        name: "goal",
        about: "goals with a sparse reward, such as pushing: hindsight and random segments",
        text: GOAL,
    },
];

// Easy tasks have smaller networks (`tasks.rs`, docs/decisions/0118-smaller-batches-in-fast.md).
const FAST: &str = r#"
[evaluation]
interval_steps = 1000
"#;

// Without random segments FetchPush stays at chance: noise around a policy that does not touch the
// object does not move it (docs/decisions/0091-preset-goal.md). With a larger rate many of the
// actor's units become inactive (docs/decisions/0122-units-that-stay-active.md).
const GOAL: &str = r#"
[algorithm]
discount = 0.98
actor_learning_rate = 0.0003
action_rate_penalty = 0.0
saturation_penalty = 0.003
imitation_penalty = 0.1
motion_bonus = 1.0
outcome_model = true
[algorithm.td3]
target_smaller_weight = 0.5
[exploration]
kind = "segment"
std = 0.2
random_segments = 0.3
settled_share = 0.4
goal_switches = 0.5
warm_up_kind = "segment"
warm_up_range = 1.0
[replay]
hindsight = "future"
other_goals_share = 0.15
near_misses_share = 0.4
moved_share = 0.5
[pacing]
updates_per_segment = 5.0
"#;

// Table 2 of the paper and section 4 of the specification. Every value is written out, so that
// changes of `default` do not affect this preset. The paper does not specify N, the widths, the
// ranges and Adam's settings; these are our choice. `tolerance_segments`, `queue_segments` and
// `publish_every_updates` are 1 to minimise the policy lag between the two processes. The Panda
// tasks have their own column in Table 2, which is merged over this (`tasks.rs`).
const PAPER: &str = r#"
[policy]
segment_steps = 5
execution = "segment"
hidden = [256, 256]
normalise_observations = false
action_range = 1.0
goal_range = 1.0
weight_range = 1.0
controller = "inverse"
rho = "bounded"
rho_range = 2.0
start = "observed"
start_velocity = "zero"
[dmp]
basis_count = 5
alpha_x = 1.0
alpha_y = 25.0
integration_steps = 40
integrator = "paper"
canonical = "euler"
widths = "ndp"
forcing_scaling = "none"
[algorithm]
name = "ddpg"
critic = "first"
windows = "segment"
target = "literal"
after_time_limit = "bootstrap"
discount = 0.99
polyak = 0.005
critic_learning_rate = 0.0003
actor_learning_rate = 0.0005
batch_size = 256
critic_hidden = [256, 256]
critic_layer_norm = false
action_rate_penalty = 0.0
action_acceleration_penalty = 0.0
jerk_cost = 0.0
saturation_penalty = 0.0
imitation_penalty = 0.0
motion_bonus = 0.0
outcome_model = false
[algorithm.td3]
target_noise_std = 0.2
target_noise_clip = 0.5
target_smaller_weight = 1.0
actor_interval = 2
[algorithm.sac]
initial_temperature = 1.0
temperature_learning_rate = 0.0003
[exploration]
kind = "gaussian"
std = 0.1
random_segments = 0.0
settled_share = 1.0
goal_switches = 0.0
warm_up_steps = 10000
warm_up_kind = "uniform"
warm_up_range = 1.0
[replay]
capacity_steps = 1000000
hindsight = "none"
hindsight_share = 0.8
other_goals_share = 0.0
near_misses_share = 0.0
moved_share = 0.0
hindsight_copies = 4
[pacing]
updates_per_segment = 1.0
tolerance_segments = 1
[actors]
workers = 1
envs_per_worker = 1
queue_segments = 1
[learner]
publish_every_updates = 1
average_share = 0.0
"#;

/// Tasks with goals and a sparse reward, ours and those of other packages: the start of a Gymnasium
/// id without its module.
const GOAL_TASKS: [&str; 10] = [
    "FetchReach",
    "FetchPush",
    "FetchSlide",
    "FetchPickAndPlace",
    "PandaReach",
    "PandaPush",
    "PandaSlide",
    "PandaPickAndPlace",
    "PandaStack",
    "PandaFlip",
];

/// Returns the preset that a task gets if the user chooses none. An environment is known only once
/// Python has started, so tasks of other packages are recognised by their ids.
#[must_use]
pub fn suitable_preset(task: &str) -> &'static str {
    let id = task_defaults(task).map_or(task, |defaults| defaults.id);
    let id = id.rsplit_once(':').map_or(id, |(_, id)| id);
    let own = id.strip_prefix("dmprl/");
    let name = own.unwrap_or(id);
    // Our own has no goals in its observation and a dense reward.
    let is_own_reach = own.is_some_and(|name| name.starts_with("PandaReach"));
    let is_sparse_goal = GOAL_TASKS.iter().any(|start| name.starts_with(start))
        && !name.contains("Dense")
        && !is_own_reach;
    if is_sparse_goal { "goal" } else { PRESETS[0].name }
}

/// Returns the values that a kind of policy changes, which are merged over task and preset. The
/// user's values override them.
///
/// `mlp` decides at every step, so two updates per decision would be five times as many per step as
/// for `dmp`. The paper's baselines do one update per step.
///
/// # Panics
/// Never: a test parses it.
#[must_use]
pub fn policy_defaults(kind: PolicyKind) -> Option<Table> {
    match kind {
        PolicyKind::Dmp | PolicyKind::Chunk => None,
        // A policy that decides at every step has more updates, so the published step size of the
        // temperature is fast enough.
        PolicyKind::Mlp => {
            let text = "[pacing]\nupdates_per_segment = 1.0\n\
                        [algorithm]\naction_rate_penalty = 0.0\n\
                        [algorithm.sac]\ntarget_entropy_per_action = -1.0\n\
                        temperature_learning_rate = 0.0003";
            Some(text.parse().expect("the built-in defaults are valid TOML"))
        }
    }
}

/// Returns the published settings of an algorithm, which are merged over task and preset. The
/// user's values override them.
///
/// Presets are made for algorithms with a replay. `ndp` needs a different start, integrator and
/// forcing term.
///
/// # Panics
/// Never: a test parses it.
#[must_use]
pub fn algorithm_defaults(name: AlgorithmName) -> Option<Table> {
    match name {
        AlgorithmName::Ndp => Some(NDP.parse().expect("the built-in defaults are valid TOML")),
        _ => None,
    }
}

// Integrator, forcing term, start and learning rates are from the released code of Neural Dynamic
// Policies. The networks are those of Table 2. Workers and pacing are not set: an on-policy update
// waits for its segments anyway.
const NDP: &str = r#"
[policy]
execution = "segment"
action_range = 1.0
controller = "position"
hidden = [256, 256]
normalise_observations = false
start = "observed"
start_velocity = "measured"
[dmp]
integrator = "explicit"
forcing_scaling = "goal"
[algorithm]
actor_learning_rate = 0.0003
critic_learning_rate = 0.0003
critic_hidden = [256, 256]
critic_layer_norm = false
action_rate_penalty = 0.0
[exploration]
random_segments = 0.0
settled_share = 1.0
goal_switches = 0.0
warm_up_steps = 0
[replay]
hindsight = "none"
"#;

impl Preset {
    /// Returns the preset's values.
    ///
    /// # Panics
    /// Never for the built-in presets: a test parses each.
    #[must_use]
    pub fn table(&self) -> Table {
        self.text.parse().expect("a built-in preset is valid TOML")
    }
}

#[cfg(test)]
mod tests {
    use super::super::{AlgorithmConfig, DmpConfig, ExperimentConfig, ExplorationConfig, Layers};
    use super::*;

    fn keys(table: &Table, section: &str) -> Vec<String> {
        let section = table.get(section).and_then(toml::Value::as_table);
        section.map(|section| section.keys().cloned().collect()).unwrap_or_default()
    }

    #[test]
    fn preset_paper_sets_every_value_that_default_may_tune() {
        let paper = PRESETS[1].table();
        let all = Table::try_from(ExperimentConfig::default()).unwrap();
        for section in ["policy", "dmp", "algorithm", "exploration", "replay", "pacing"] {
            let missing = |key: &String| !keys(&paper, section).contains(key);
            let missing: Vec<_> = keys(&all, section).into_iter().filter(missing).collect();
            // The kind of policy and the settings of other algorithms are the user's choice.
            let is_from_paper = |key: &String| {
                !["kind", "td3", "sac", "tqc", "ndp", "position_scale"].contains(&key.as_str())
            };
            let missing: Vec<_> = missing.into_iter().filter(is_from_paper).collect();
            assert!(missing.is_empty(), "{section}: {missing:?}");
        }
    }

    #[test]
    fn preset_goal_is_chosen_for_sparse_goals_of_known_packages_only() {
        for (task, preset) in [
            ("gymnasium_robotics:FetchPush-v4", "goal"),
            ("panda_gym:PandaPickAndPlaceJoints-v3", "goal"),
            ("FetchPickAndPlace-v4", "goal"),
            ("gymnasium_robotics:FetchPushDense-v4", "default"),
            ("dmprl/PandaReach-v0", "default"),
            ("panda-reach", "default"),
            ("panda-push", "goal"),
            ("panda-stack-dense", "default"),
            ("dmprl/PandaPickAndPlaceJoints-v0", "goal"),
            ("reacher", "default"),
        ] {
            assert_eq!(suitable_preset(task), preset, "{task}");
        }
    }

    #[test]
    fn preset_paper_matches_table_2() {
        let mut layers = Layers::new();
        layers.add("paper", PRESETS[1].table()).unwrap();
        let config = layers.finish().unwrap();
        let AlgorithmConfig { discount, polyak, batch_size, .. } = config.algorithm;
        assert_eq!((discount, polyak, batch_size), (0.99, 5e-3, 256));
        let AlgorithmConfig { critic_learning_rate, actor_learning_rate, .. } = config.algorithm;
        assert_eq!((critic_learning_rate, actor_learning_rate), (3e-4, 5e-4));
        assert_eq!((config.policy.hidden, config.policy.segment_steps), (vec![256, 256], 5));
        let DmpConfig { integration_steps, alpha_y, .. } = config.dmp;
        assert_eq!((integration_steps, alpha_y), (40, 25.0));
        let ExplorationConfig { warm_up_steps, std, .. } = config.exploration;
        assert_eq!((warm_up_steps, std, config.replay.capacity_steps), (10_000, 0.1, 1_000_000));
    }
}
