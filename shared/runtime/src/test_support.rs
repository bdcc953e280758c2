//! Helpers of tests.

use serde_json::Value;

use crate::config::{AlgorithmName, DmpConfig, PolicyConfig};
use crate::policy::PolicyDescription;
use crate::spec::EnvSpec;

/// Describes the default policy with other values for some keys, in JSON; a value that is not JSON
/// is a text.
pub fn description(spec: EnvSpec, keys: &[(&str, &str)]) -> PolicyDescription {
    let mut description = serde_json::to_value(PolicyDescription {
        spec,
        algorithm: AlgorithmName::Td3,
        policy: PolicyConfig::default(),
        dmp: DmpConfig::default(),
        start_sources: Vec::new(),
        task_options: None,
    })
    .unwrap();
    for (key, text) in keys {
        let value = serde_json::from_str(text).unwrap_or_else(|_| Value::from(*text));
        key.split('.').fold(&mut description, |part, name| &mut part[name]).clone_from(&value);
    }
    serde_json::from_value(description).unwrap()
}
