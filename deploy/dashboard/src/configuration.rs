//! Flattens a configuration into keys and values, so that runs can be compared.

use std::collections::BTreeMap;

use dmprl_run::sweep_files::flatten;
use dmprl_shared::config::ExperimentConfig;
use toml::Table;

/// Returns the value of every key `section.key`, in TOML syntax.
///
/// # Errors
/// The configuration cannot be serialized, which is not expected.
pub fn flattened(config: &ExperimentConfig) -> anyhow::Result<BTreeMap<String, String>> {
    let keys = flatten(&Table::try_from(config)?);
    Ok(keys.into_iter().map(|(key, value)| (key, value.to_string())).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_have_the_names_used_on_the_command_line() {
        let keys = flattened(&ExperimentConfig::default()).unwrap();
        assert_eq!(keys["algorithm.td3.actor_interval"], "2");
        assert!(keys["policy.hidden"].starts_with('['));
        assert!(keys["run.until_return"].contains("inf"));
    }
}
