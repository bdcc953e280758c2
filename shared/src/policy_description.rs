//! The policy that a configuration describes.

use std::collections::BTreeMap;

use toml::Value;

use crate::config::{ExperimentConfig, TaskConfig};
use crate::policy::PolicyDescription;
use crate::spec::EnvSpec;

impl ExperimentConfig {
    /// Describes the policy for an environment.
    #[must_use]
    pub fn policy_description(&self, spec: &EnvSpec) -> PolicyDescription {
        PolicyDescription {
            spec: spec.clone(),
            algorithm: self.algorithm.name,
            policy: self.policy.clone(),
            dmp: self.dmp.clone(),
            start_sources: self.task.start_sources.clone(),
            task_options: self.task.has_options().then(|| options(&self.task)),
        }
    }
}

/// Returns arguments and wrappers as text.
fn options(task: &TaskConfig) -> String {
    format!("{} {:?}", sorted(&Value::Table(task.kwargs.clone())), task.wrappers)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Layers;
    use crate::policy::Policy;

    fn spec() -> EnvSpec {
        EnvSpec::new("Reacher-v5", 10, &[(-1.0, 1.0); 2], 0.02, 50)
    }

    fn hash_of(keys: &[(&str, &str)]) -> u64 {
        let mut layers = Layers::new();
        let source = "{ index = 3, velocity = 2 }";
        layers.set("test", "task.start_sources", &format!("[{source}, {source}]")).unwrap();
        for (key, value) in keys {
            layers.set("test", key, value).unwrap();
        }
        let description = layers.finish().unwrap().policy_description(&spec());
        Policy::new(description).unwrap().architecture_hash()
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
            ("policy.controller", "direct"),
            ("policy.start", "action"),
            ("algorithm.name", "ndp"),
        ] {
            assert_ne!(hash_of(&[(key, value)]), same, "{key}");
        }
        let ndp = ("algorithm.name", "ndp");
        assert_ne!(hash_of(&[ndp, ("policy.controller", "position")]), hash_of(&[ndp]));
        let mlp = ("policy.kind", "mlp");
        assert_eq!(hash_of(&[mlp, ("dmp.alpha_y", "12.0")]), hash_of(&[mlp]));
    }
}
