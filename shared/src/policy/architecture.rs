//! Hash of a policy's architecture. With equal hashes, equal parameters and observations give equal
//! actions.

use std::collections::BTreeMap;

use toml::Value;

use crate::config::{AlgorithmName, Controller, ExperimentConfig, PolicyKind, StartSource};
use crate::seeds;
use crate::spec::EnvSpec;

/// Version of the hashed list. A new version makes all stored snapshots, policy files and
/// checkpoints invalid.
const VERSION: u32 = 1;

/// Hashes an explicit list of the values that determine the policy's actions. Keys that are added
/// later, or that this kind of policy does not use, do not change the hash of stored policies.
pub(super) fn hash(config: &ExperimentConfig, spec: &EnvSpec) -> u64 {
    let mut list = format!(
        "{VERSION} {} {} {} {:?} {:?} {:?}",
        spec.id,
        spec.observation_len,
        spec.action_len,
        spec.action_low,
        spec.action_high,
        config.policy.hidden,
    );
    // The same id with other arguments is another environment.
    if config.task.has_options() {
        let kwargs = sorted(&Value::Table(config.task.kwargs.clone()));
        list.push_str(&format!(" task {kwargs} {:?}", config.task.wrappers));
    }
    if config.policy.action_range != 1.0 {
        list.push_str(&format!(" range {:?}", config.policy.action_range));
    }
    match config.policy.kind {
        PolicyKind::Mlp => list.push_str(" mlp"),
        PolicyKind::Chunk => list.push_str(&format!(" chunk {}", config.policy.segment_steps)),
        PolicyKind::Dmp => list.push_str(&dmp(config, spec)),
    }
    if config.policy.follows_actions() {
        list.push_str(" follows actions");
    }
    if config.algorithm.name.has_gaussian_policy() {
        list.push_str(" squashed gaussian");
    }
    if config.algorithm.name == AlgorithmName::Ndp {
        list.push_str(" learned std");
    }
    seeds::derive(0, &list, 0)
}

/// Formats a value with the keys of its tables in order, which a build of `toml` may not have.
fn sorted(value: &Value) -> String {
    match value {
        Value::Table(table) => {
            let texts: BTreeMap<_, _> =
                table.iter().map(|(key, value)| (key, sorted(value))).collect();
            format!("{texts:?}")
        }
        Value::Array(values) => format!("{:?}", values.iter().map(sorted).collect::<Vec<_>>()),
        value => format!("{value:?}"),
    }
}

fn dmp(config: &ExperimentConfig, spec: &EnvSpec) -> String {
    let (policy, dmp) = (&config.policy, &config.dmp);
    let mut list = format!(
        " dmp {} {} {:?} {:?} {} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?}",
        policy.segment_steps,
        dmp.basis_count,
        dmp.alpha_x,
        dmp.alpha_y,
        dmp.integration_steps,
        dmp.integrator,
        dmp.canonical,
        dmp.widths,
        dmp.forcing_scaling,
        policy.goal_range,
        policy.weight_range,
        policy.rho,
        policy.rho_range,
        policy.start,
        policy.start_velocity,
    );
    match policy.controller {
        Controller::Inverse => {}
        Controller::Position => list.push_str(&format!(" position {:?}", policy.position_scale)),
        Controller::Direct => list.push_str(" direct"),
    }
    if policy.start == crate::config::Start::Observed {
        list.push_str(&format!(" {:?}", spec.control_dt_s));
        for source in &config.task.start_sources {
            list.push_str(&match source {
                StartSource::Angle { cos, sin, velocity } => {
                    format!(" angle {cos} {sin} {velocity}")
                }
                StartSource::Value { index, velocity, scale } => {
                    format!(" value {index} {velocity} {scale:?}")
                }
            });
        }
    }
    list
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Layers;

    fn spec() -> EnvSpec {
        EnvSpec {
            id: "Reacher-v5".into(),
            observation_len: 10,
            action_len: 2,
            action_low: vec![-1.0; 2],
            action_high: vec![1.0; 2],
            control_dt_s: 0.02,
            episode_steps: 50,
            observation_names: Vec::new(),
            goal_rule: None,
        }
    }

    fn hash_of(keys: &[(&str, &str)]) -> u64 {
        let mut layers = Layers::new();
        for (key, value) in keys {
            layers.set("test", key, value).unwrap();
        }
        hash(&layers.finish().unwrap(), &spec())
    }

    #[test]
    fn hash_of_the_default_policy_is_unchanged() {
        // A different hash invalidates every stored checkpoint and policy. If the change is
        // intended, raise VERSION and document it in the changelog.
        assert_eq!(format!("{:016x}", hash_of(&[])), "458fc872445cefcd");
    }

    #[test]
    fn hash_of_a_task_with_arguments_is_unchanged() {
        let hash = hash_of(&[
            ("task.kwargs", "{ b = 1, a = \"x\", c = 1.5, e = { g = 2, f = 1 }, d = [true, inf] }"),
            ("task.wrappers", "[\"module:name\"]"),
        ]);
        assert_eq!(format!("{hash:016x}"), "72267294194189d7");
    }

    #[test]
    fn hash_depends_only_on_values_that_determine_the_actions() {
        let same = hash_of(&[]);
        for (key, value) in [
            ("algorithm.batch_size", "8"),
            ("task.python_path", "[\"x\"]"),
            ("policy.position_scale", "2.0"),
            // A policy trained without randomisation can be evaluated with it.
            ("task.randomise.mass", "[0.5, 2.0]"),
        ] {
            assert_eq!(hash_of(&[(key, value)]), same, "{key}");
        }
        for (key, value) in [
            ("task.kwargs.reward_type", "dense"),
            ("task.wrappers", "[\"module:name\"]"),
            ("policy.hidden", "[256]"),
            ("policy.action_range", "0.5"),
            ("policy.rho_range", "1.0"),
            ("policy.start", "observed"),
            ("dmp.alpha_y", "12.0"),
            ("dmp.integrator", "explicit"),
            ("policy.kind", "mlp"),
            ("policy.kind", "chunk"),
            ("algorithm.name", "sac"),
            ("policy.controller", "position"),
            ("policy.controller", "direct"),
            ("policy.start", "action"),
            ("algorithm.name", "ndp"),
        ] {
            assert_ne!(hash_of(&[(key, value)]), same, "{key}");
        }
        let mlp = ("policy.kind", "mlp");
        assert_eq!(hash_of(&[mlp, ("dmp.alpha_y", "12.0")]), hash_of(&[mlp]));
    }
}
