//! Merges the layers of configuration. Unknown keys are rejected, with the nearest known name.

use thiserror::Error;
use toml::{Table, Value};

use super::{ExperimentConfig, RangeError};

/// Maximum number of names in a dotted key; real keys have fewer.
const KEY_NAMES_MAX: usize = 16;

/// A table whose names are not ours: the environment's arguments.
const OPEN_TABLE: &str = "task.kwargs";

/// Why a configuration was rejected.
#[derive(Debug, Error, PartialEq)]
pub enum ConfigError {
    /// A key that does not exist.
    #[error("{origin}: unknown key `{key}`{hint}")]
    UnknownKey {
        /// The layer that contains it: a file name, `--set`, an environment variable.
        origin: String,
        /// The dotted key.
        key: String,
        /// `, did you mean ...?`, or empty.
        hint: String,
    },
    /// A value of the wrong type, or a word that is not among the allowed ones.
    #[error("{origin}: {message}")]
    Value {
        /// The layer that contains it.
        origin: String,
        /// Description with key, expected and actual value.
        message: String,
    },
    /// A value out of range, or one that conflicts with another value.
    #[error(transparent)]
    Range(#[from] RangeError),
}

/// The configuration layers merged so far.
#[derive(Debug, Clone)]
pub struct Layers {
    known: Table,
    merged: Table,
}

impl Default for Layers {
    fn default() -> Self {
        Self::new()
    }
}

impl Layers {
    /// Creates the lowest layer: the defaults.
    ///
    /// # Panics
    /// Never: a test checks that the defaults serialise.
    #[must_use]
    pub fn new() -> Self {
        let known = Table::try_from(ExperimentConfig::default()).expect("defaults serialise");
        Self { merged: known.clone(), known }
    }

    /// Merges `table` over the existing layers.
    ///
    /// # Errors
    /// `UnknownKey` if a key does not exist, `Value` for a wrong type. The layers are then
    /// unchanged.
    pub fn add(&mut self, origin: &str, table: Table) -> Result<(), ConfigError> {
        check_keys(origin, &self.known, &table, "")?;
        let mut merged = self.merged.clone();
        merge(&mut merged, table);
        typed(origin, merged.clone())?;
        self.merged = merged;
        Ok(())
    }

    /// Merges one dotted key over the existing layers, for `--set key=value` and `DMPRL_KEY`.
    ///
    /// A value that is not a TOML literal is treated as a string.
    ///
    /// # Errors
    /// The errors of [`Layers::add`]. `Value` for an environment's argument in Python's notation.
    pub fn set(&mut self, origin: &str, key: &str, text: &str) -> Result<(), ConfigError> {
        if key.split('.').nth(KEY_NAMES_MAX).is_some() {
            // No key is this long. Dropping a tree of this depth would overflow the stack.
            let (origin, hint) = (origin.to_owned(), String::new());
            let key = key.split('.').take(KEY_NAMES_MAX).collect::<Vec<_>>().join(".") + "...";
            return Err(ConfigError::UnknownKey { origin, key, hint });
        }
        if key.starts_with(OPEN_TABLE) {
            check_notation(origin, key, text)?;
        }
        let value = format!("value = {text}")
            .parse::<Table>()
            .ok()
            // Rejects a text of several lines, which could set other keys.
            .filter(|table| table.len() == 1)
            .and_then(|mut table| table.remove("value"))
            .unwrap_or_else(|| Value::String(text.to_owned()));
        let value = self.widen(key, value);
        let mut table = Table::new();
        let mut path: Vec<&str> = key.split('.').collect();
        let last = path.pop().unwrap_or_default();
        let mut inner = Table::new();
        inner.insert(last.to_owned(), value);
        for name in path.into_iter().rev() {
            let mut outer = Table::new();
            outer.insert(name.to_owned(), Value::Table(inner));
            inner = outer;
        }
        table.extend(inner);
        self.add(origin, table)
    }

    /// Returns the dotted keys that a user may set, sorted.
    #[must_use]
    pub fn keys(&self) -> Vec<String> {
        let mut keys = Vec::new();
        collect_keys(&self.known, "", &mut keys);
        keys
    }

    /// Returns the merged configuration.
    ///
    /// # Errors
    /// `Value` if a value does not fit its type, which does not happen: `add` rejects it first.
    pub fn finish(self) -> Result<ExperimentConfig, ConfigError> {
        typed("configuration", self.merged)
    }

    /// Converts an integer to a float if the key is a float, so that `--set x=1` is accepted.
    fn widen(&self, key: &str, value: Value) -> Value {
        let default = key.split('.').try_fold(None::<&Value>, |at, name| match at {
            None => self.known.get(name).map(Some),
            Some(value) => value.get(name).map(Some),
        });
        match (default.flatten(), &value) {
            (Some(Value::Float(_)), Value::Integer(integer)) => Value::Float(*integer as f64),
            _ => value,
        }
    }
}

/// Returns the candidate that is most similar to `name`, if `name` could be a typo of it.
#[must_use]
pub fn nearest<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    candidates
        .into_iter()
        .map(|candidate| (strsim::jaro_winkler(name, candidate), candidate))
        .filter(|(similarity, _)| *similarity > 0.75)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, candidate)| candidate)
}

fn typed(origin: &str, table: Table) -> Result<ExperimentConfig, ConfigError> {
    table.try_into().map_err(|error: toml::de::Error| ConfigError::Value {
        origin: origin.to_owned(),
        message: error.to_string().trim().replace('\n', ", "),
    })
}

/// Rejects Python's literals, which would become texts: `"False"` is true in Python.
fn check_notation(origin: &str, key: &str, text: &str) -> Result<(), ConfigError> {
    let advice = match text {
        "True" | "False" => format!("such as {}", text.to_ascii_lowercase()),
        "None" => "but TOML has no None; leave the argument out".to_owned(),
        _ => return Ok(()),
    };
    let message = format!(
        "`{key}` = {text}: expected a TOML value, {advice}; for the text, quote it: '\"{text}\"'"
    );
    Err(ConfigError::Value { origin: origin.to_owned(), message })
}

fn check_keys(origin: &str, known: &Table, given: &Table, path: &str) -> Result<(), ConfigError> {
    for (name, value) in given {
        let key = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
        match (known.get(name), value) {
            (None, _) => return Err(unknown(origin, key, name, known, path)),
            (Some(_), Value::Table(_)) if key == OPEN_TABLE => {}
            (Some(Value::Table(known)), Value::Table(given)) => {
                check_keys(origin, known, given, &key)?;
            }
            (Some(Value::Table(_)), _) => {
                return Err(ConfigError::Value {
                    origin: origin.to_owned(),
                    message: format!("`{key}`: expected a table, got {value}"),
                });
            }
            _ => {}
        }
    }
    Ok(())
}

/// Creates the error for an unknown key. The hint is the nearest key in the same table, or else in
/// the whole tree, so that `batch_size` suggests `algorithm.batch_size`.
fn unknown(origin: &str, key: String, name: &str, siblings: &Table, path: &str) -> ConfigError {
    let sibling = nearest(name, siblings.keys().map(String::as_str))
        .map(|near| if path.is_empty() { near.to_owned() } else { format!("{path}.{near}") });
    let anywhere = || {
        let keys = Layers::new().keys();
        let leaf = |key: &'_ String| key.rsplit('.').next().unwrap_or_default().to_owned();
        let leaves: Vec<String> = keys.iter().map(leaf).collect();
        let near = nearest(name, leaves.iter().map(String::as_str))?;
        keys.iter().find(|key| leaf(key) == near).cloned()
    };
    let hint = sibling.or_else(anywhere).map(|near| format!(", did you mean `{near}`?"));
    ConfigError::UnknownKey { origin: origin.to_owned(), key, hint: hint.unwrap_or_default() }
}

fn merge(under: &mut Table, over: Table) {
    for (key, value) in over {
        match (under.get_mut(&key), value) {
            (Some(Value::Table(under)), Value::Table(over)) => merge(under, over),
            (_, value) => {
                under.insert(key, value);
            }
        }
    }
}

fn collect_keys(table: &Table, path: &str, keys: &mut Vec<String>) {
    for (name, value) in table {
        let key = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
        match value {
            Value::Table(inner) if key != OPEN_TABLE => collect_keys(inner, &key, keys),
            _ => keys.push(key),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{PRESETS, PolicyKind, TASKS, policy_defaults};
    use super::*;

    #[test]
    fn every_preset_and_task_is_a_valid_layer() {
        Layers::new().add("mlp", policy_defaults(PolicyKind::Mlp).unwrap()).unwrap();
        for (name, table) in PRESETS
            .iter()
            .map(|preset| (preset.name, preset.table()))
            .chain(TASKS.iter().map(|task| (task.name, task.table())))
        {
            Layers::new().add(name, table).unwrap();
        }
    }

    #[test]
    fn later_layer_overrides_only_its_own_keys() {
        let mut layers = Layers::new();
        layers.add("file", "[dmp]\nalpha_y = 7.0".parse().unwrap()).unwrap();
        layers.set("--set", "dmp.basis_count", "3").unwrap();
        layers.set("--set", "dmp.alpha_y", "8").unwrap();
        let config = layers.finish().unwrap();
        assert_eq!((config.dmp.alpha_y, config.dmp.basis_count), (8.0, 3));
        assert_eq!(config.algorithm.batch_size, 128);
    }

    #[test]
    fn unknown_key_is_rejected_with_the_nearest_name() {
        let mut layers = Layers::new();
        for (given, near) in [
            ("algorithm.bach_size", "algorithm.batch_size"),
            ("batch_size", "algorithm.batch_size"),
            ("bach_size", "algorithm.batch_size"),
            ("algoritm.batch_size", "algorithm"),
        ] {
            let message = layers.set("--set", given, "64").unwrap_err().to_string();
            assert!(message.contains(&format!("did you mean `{near}`")), "{given}: {message}");
        }
    }

    /// Regression: dropping the nested tables overflowed the stack and crashed the program.
    #[test]
    fn overlong_key_is_rejected_as_unknown() {
        let error = Layers::new().set("--set", &"a.".repeat(100_000), "1").unwrap_err();
        assert!(matches!(error, ConfigError::UnknownKey { .. }), "{error}");
        assert!(error.to_string().len() < 100, "{error}");
    }

    /// Regression: the second line was silently dropped.
    #[test]
    fn multi_line_value_sets_no_other_key() {
        let mut layers = Layers::new();
        assert!(layers.set("--set", "run.seed", "1\nsteps = 2").is_err());
        assert_eq!(layers.finish().unwrap(), ExperimentConfig::default());
    }

    #[test]
    fn value_of_the_wrong_type_is_rejected_and_changes_nothing() {
        let mut layers = Layers::new();
        let error = layers.set("--set", "algorithm.critic", "third").unwrap_err().to_string();
        assert!(error.contains("third") && error.contains("segment"), "{error}");
        assert_eq!(layers.finish().unwrap(), ExperimentConfig::default());
    }

    #[test]
    fn configuration_survives_a_round_trip_through_toml() {
        let config = ExperimentConfig::default();
        let text = toml::to_string(&config).unwrap();
        assert_eq!(toml::from_str::<ExperimentConfig>(&text).unwrap(), config);
    }
}
