//! Flattens a configuration to keys and values, for comparison.

use std::collections::BTreeMap;

use dmprl_run::sweep_files::flatten;
use dmprl_shared::config::ExperimentConfig;
use toml::Table;

/// Returns every key as `section.key`, with its value in TOML.
///
/// # Errors
/// None is known: a configuration that was read can be written.
pub fn flat(config: &ExperimentConfig) -> anyhow::Result<BTreeMap<String, String>> {
    let keys = flatten(&Table::try_from(config)?);
    Ok(keys.into_iter().map(|(key, value)| (key, value.to_string())).collect())
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
