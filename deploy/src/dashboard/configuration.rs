//! A configuration as keys and values, to be set beside another's.

use std::collections::BTreeMap;

use dmprl_shared::config::ExperimentConfig;
use toml::Value;

/// Every key as `section.key`, with its value as a file would have it.
///
/// # Errors
/// None is known: a configuration that was read can be written.
pub fn flat(config: &ExperimentConfig) -> anyhow::Result<BTreeMap<String, String>> {
    let mut keys = BTreeMap::new();
    add(String::new(), &Value::try_from(config)?, &mut keys);
    Ok(keys)
}

fn add(name: String, value: &Value, keys: &mut BTreeMap<String, String>) {
    match value {
        Value::Table(table) => {
            for (key, value) in table {
                let name = if name.is_empty() { key.clone() } else { format!("{name}.{key}") };
                add(name, value, keys);
            }
        }
        other => drop(keys.insert(name, other.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_called_as_on_the_command_line() {
        let keys = flat(&ExperimentConfig::default()).unwrap();
        assert_eq!(keys["algorithm.td3.actor_interval"], "2");
        assert!(keys["policy.hidden"].starts_with('['));
        assert!(keys["run.until_return"].contains("inf"));
    }
}
