//! Named sets of values between the task defaults and the user's file.

use toml::Table;

use super::{AlgorithmName, PolicyKind};

/// A preset: its name, a one-line description, and its values as TOML.
#[derive(Debug)]
pub struct Preset {
    /// The name for `--preset`.
    pub name: &'static str,
    /// Its purpose, in one line.
    pub about: &'static str,
    text: &'static str,
}

/// All presets, in the order of `--help`.
pub const PRESETS: [Preset; 3] = [
    Preset {
        name: "default",
        about: "segment critic, sliding windows, n-step target: best in our measurements",
        text: "",
    },
    Preset {
        name: "paper",
        about: "one reading of the paper: first-action critic, literal target, its Table 2",
        text: PAPER,
    },
    Preset {
        name: "fast",
        about: "least wall time: the update on two threads, evaluated often, so that \
                --until-return and --until-success stop it soon",
        text: FAST,
    },
];

// The usual ways to save time on GPUs do not help here, because an update takes as long as its
// matrix products. Larger batches, fewer updates per step, and smaller networks or batches were no
// faster on reacher beyond the spread of three seeds (docs/decisions/0031-preset-fast.md).
const FAST: &str = r#"
[learner]
threads = 2
[evaluation]
interval_steps = 1000
"#;

// Table 2 of the paper and section 4 of the specification, written out in full, so that changes of
// `default` do not affect the paper's settings. The paper leaves N, widths, ranges and Adam open;
// these values are our reading. `tolerance_segments`, `queue_segments` and `publish_every_updates`
// of 1 keep the worker as close behind its learner as two processes can be. The Panda tasks have
// their own column in Table 2, which is merged over this (`tasks.rs`).
const PAPER: &str = r#"
[policy]
segment_steps = 5
hidden = [256, 256]
normalise_observations = false
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
discount = 0.99
polyak = 0.005
critic_learning_rate = 0.0003
actor_learning_rate = 0.0005
batch_size = 256
critic_hidden = [256, 256]
critic_layer_norm = false
action_rate_penalty = 0.0
[algorithm.td3]
target_noise_std = 0.2
target_noise_clip = 0.5
actor_interval = 2
[algorithm.sac]
initial_temperature = 1.0
temperature_learning_rate = 0.0003
[exploration]
kind = "gaussian"
std = 0.1
warm_up_steps = 10000
warm_up_kind = "uniform"
warm_up_range = 1.0
[replay]
capacity_steps = 1000000
hindsight = "none"
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
"#;

/// Values that differ from the defaults for a kind of policy, merged over those of the task.
///
/// `mlp` decides at every step, so two updates per decision would be ten times as many as for
/// `dmp`. The paper's baselines do one per step.
///
/// # Panics
/// Never: a test parses it.
#[must_use]
pub fn policy_defaults(kind: PolicyKind) -> Option<Table> {
    match kind {
        PolicyKind::Dmp => None,
        // The target entropy also belongs to the baselines; no preset sets it.
        PolicyKind::Mlp => {
            let text = "[pacing]\nupdates_per_segment = 1.0\n\
                        [algorithm]\naction_rate_penalty = 0.0\n\
                        [algorithm.sac]\ntarget_entropy_per_action = -1.0";
            Some(text.parse().expect("the built-in defaults are valid TOML"))
        }
    }
}

/// Published settings of an algorithm, merged over task and preset and below the user's own values.
///
/// Presets describe DDPG-DMP; other algorithms use a different start, integrator and forcing.
///
/// # Panics
/// Never: a test parses it.
#[must_use]
pub fn algorithm_defaults(name: AlgorithmName) -> Option<Table> {
    match name {
        AlgorithmName::Ddpg | AlgorithmName::Td3 | AlgorithmName::Sac => None,
        AlgorithmName::Ndp => Some(NDP.parse().expect("the built-in defaults are valid TOML")),
    }
}

// From the released code of Neural Dynamic Policies: integrator, forcing, start, learning rates.
// The networks are those of Table 2. Workers and pacing are not set: on-policy, each update waits
// for its segments.
const NDP: &str = r#"
[policy]
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
action_rate_penalty = 0.0
[exploration]
warm_up_steps = 0
"#;

impl Preset {
    /// The preset's values.
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
    fn the_paper_states_every_value_that_the_default_may_tune() {
        let paper = PRESETS[1].table();
        let all = Table::try_from(ExperimentConfig::default()).unwrap();
        for section in ["policy", "dmp", "algorithm", "exploration", "replay", "pacing"] {
            let missing = |key: &String| !keys(&paper, section).contains(key);
            let missing: Vec<_> = keys(&all, section).into_iter().filter(missing).collect();
            // A policy without a DMP is the user's choice, not the paper's. The same holds for
            // another algorithm and its settings.
            let others = |key: &String| {
                !["kind", "td3", "sac", "ndp", "position_scale"].contains(&key.as_str())
            };
            let missing: Vec<_> = missing.into_iter().filter(others).collect();
            assert!(missing.is_empty(), "{section}: {missing:?}");
        }
    }

    #[test]
    fn the_paper_is_table_2() {
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
