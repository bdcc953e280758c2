//! The environment: its id, arguments and wrappers.

use std::collections::{BTreeMap, BTreeSet};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::{RandomiseConfig, RangeError, StartSource};

/// The environment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TaskConfig {
    /// Name of the task on the command line.
    pub name: String,
    /// Gymnasium id (`Name-vN` or `module:Name-vN`), or a class (`module:Class`).
    pub id: String,
    /// Directories that are searched for your own environment modules.
    pub python_path: Vec<String>,
    /// Entries of the observation from which y0 and yd0 are read, one source per action dimension;
    /// empty: unknown.
    pub start_sources: Vec<StartSource>,
    /// Wrappers around the environment, each a class or function (`module:name`) that takes an
    /// environment and returns one. They are applied in order, the first directly outside the time
    /// limit.
    pub wrappers: Vec<String>,
    /// Arguments of `gymnasium.make`, such as `max_episode_steps`, and of the environment itself;
    /// `--env-kwargs` sets one. The environment decides which names and values are valid.
    #[schemars(with = "BTreeMap<String, serde_json::Value>")]
    pub kwargs: Table,
    /// Physics and delays drawn for each episode.
    pub randomise: RandomiseConfig,
}

impl Default for TaskConfig {
    fn default() -> Self {
        Self {
            name: "reacher".into(),
            id: "Reacher-v5".into(),
            python_path: Vec::new(),
            start_sources: Vec::new(),
            wrappers: Vec::new(),
            kwargs: Table::new(),
            randomise: RandomiseConfig::default(),
        }
    }
}

/// The part of a task that Python reads as TOML.
#[derive(Serialize)]
struct Options<'a> {
    wrappers: &'a [String],
    kwargs: &'a Table,
    #[serde(skip_serializing_if = "RandomiseConfig::is_nominal")]
    randomise: &'a RandomiseConfig,
}

impl TaskConfig {
    /// Returns the task with this id and without arguments or wrappers.
    #[must_use]
    pub fn with_id(id: &str) -> Self {
        Self { name: id.into(), id: id.into(), ..Self::default() }
    }

    /// Returns the Python modules that this configuration imports by name: those of the id and of
    /// the wrappers. A program that did not get the configuration from its own user must not create
    /// the environment unless the user allowed these modules.
    #[must_use]
    pub fn imports(&self) -> BTreeSet<&str> {
        let names = std::iter::once(&self.id).chain(&self.wrappers);
        // As in Python (`dmprl.segment_env.named_object`), the last colon separates the name.
        names.filter_map(|name| Some(name.rsplit_once(':')?.0)).collect()
    }

    /// Whether the environment has arguments or wrappers, which make it another environment.
    #[must_use]
    pub fn has_options(&self) -> bool {
        !self.kwargs.is_empty() || !self.wrappers.is_empty()
    }

    /// Returns `wrappers`, `kwargs` and, unless it is nominal, `randomise` as TOML, for
    /// `dmprl.env_options` in Python. Unlike JSON, it has infinity and keeps integers and floats
    /// apart.
    ///
    /// # Panics
    /// Never: every TOML table can be written.
    #[must_use]
    pub fn options_toml(&self) -> String {
        let Self { wrappers, kwargs, randomise, .. } = self;
        let options = Options { wrappers, kwargs, randomise };
        toml::to_string(&options).expect("a table of TOML values can be written as TOML")
    }

    /// Checks names and ranges; only the environment knows which arguments are valid.
    pub(super) fn check(&self) -> Result<(), RangeError> {
        let range = |key, expected: &str, got: &str| {
            let expected = format!("expected {expected}");
            Err(RangeError { key, expected, got: got.to_owned() })
        };
        // They are shown before code is trusted, and must not be able to hide a line.
        for (key, texts) in [
            ("task.name", std::slice::from_ref(&self.name)),
            ("task.id", std::slice::from_ref(&self.id)),
            ("task.python_path", &self.python_path),
        ] {
            if let Some(text) = texts.iter().find(|text| text.chars().any(char::is_control)) {
                return range(key, "no control characters", &format!("{text:?}"));
            }
        }
        if let Some(name) = self.wrappers.iter().find(|name| !is_python_object(name)) {
            return range("task.wrappers", "module:function or module:Class", name);
        }
        for (name, value) in &self.kwargs {
            if !is_identifier(name) {
                return range("task.kwargs", "names of Python arguments, as in reward_type", name);
            }
            if has_nan(value) {
                return range("task.kwargs", "no NaN", &format!("{name} = {value}"));
            }
        }
        self.randomise.check()
    }
}

/// Returns true for `[package.]module:name`, which names an object of a Python module.
#[must_use]
pub fn is_python_object(text: &str) -> bool {
    text.split_once(':')
        .is_some_and(|(module, name)| module.split('.').all(is_identifier) && is_identifier(name))
}

fn is_identifier(text: &str) -> bool {
    text.starts_with(|letter: char| letter.is_ascii_alphabetic() || letter == '_')
        && text.chars().all(|letter| letter.is_ascii_alphanumeric() || letter == '_')
}

/// With NaN, a configuration would differ from itself.
fn has_nan(value: &Value) -> bool {
    match value {
        Value::Float(number) => number.is_nan(),
        Value::Array(values) => values.iter().any(has_nan),
        Value::Table(table) => table.iter().any(|(_, value)| has_nan(value)),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::super::{ConfigError, ExperimentConfig, Layers, Limits};
    use super::*;

    fn layered(settings: &[(&str, &str)]) -> Result<ExperimentConfig, ConfigError> {
        let mut layers = Layers::new();
        for (key, value) in settings {
            layers.set("--set", key, value)?;
        }
        layers.finish()?.resolve(Limits { cores: 2 })
    }

    #[test]
    fn imports_are_the_modules_of_the_id_and_the_wrappers() {
        let mut task = TaskConfig::with_id("Pendulum-v1");
        assert!(task.imports().is_empty());
        task.id = "my.arms:Arm".into();
        task.wrappers = vec!["tools:slow".into(), "my.arms:scale".into()];
        assert_eq!(task.imports().into_iter().collect::<Vec<_>>(), ["my.arms", "tools"]);
    }

    #[test]
    fn names_cannot_hide_lines_of_a_terminal() {
        for (key, value) in [
            ("task.name", "arm\u{1b}[2K"),
            ("task.id", "arm\rx"),
            ("task.python_path", r#"["a\nb"]"#),
        ] {
            let error = layered(&[(key, value)]).unwrap_err().to_string();
            assert!(error.contains("no control characters"), "{key}: {error}");
        }
    }

    #[test]
    fn arguments_are_toml_values_and_bare_words() {
        let config = layered(&[
            ("task.kwargs.reward_type", "dense"),
            ("task.kwargs.control_type", "\"joints\""),
            ("task.kwargs.max_episode_steps", "100"),
            ("task.kwargs.scale", "2.0"),
            ("task.kwargs.render", "false"),
            ("task.kwargs.range", "[0.7, inf]"),
            ("task.kwargs.controller.gain", "3"),
        ]);
        let kwargs = config.unwrap().task.kwargs;
        let expected: Table = "reward_type = 'dense'\ncontrol_type = 'joints'\n\
            max_episode_steps = 100\nscale = 2.0\nrender = false\nrange = [0.7, inf]\n\
            controller.gain = 3"
            .parse()
            .unwrap();
        assert_eq!(kwargs, expected);
    }

    #[test]
    fn later_layers_replace_single_arguments() {
        let mut layers = Layers::new();
        let file = "[task.kwargs]\nreward_type = 'sparse'\nlength = 3".parse().unwrap();
        layers.add("file", file).unwrap();
        layers.set("environment", "task.kwargs.length", "4").unwrap();
        layers.set("--set", "task.kwargs", "{ reward_type = 'dense' }").unwrap();
        let kwargs = layers.finish().unwrap().task.kwargs;
        assert_eq!(kwargs, "reward_type = 'dense'\nlength = 4".parse().unwrap());
    }

    #[test]
    fn options_are_toml_with_both_keys() {
        let mut task = TaskConfig::with_id("Pendulum-v1");
        assert!(!task.has_options());
        assert_eq!(task.options_toml(), "wrappers = []\n\n[kwargs]\n");
        task.kwargs = "g = 9.0\nrange = [0, inf]\nnested = { a = 1 }".parse().unwrap();
        task.wrappers.push("tools:slow".into());
        let read: Table = task.options_toml().parse().unwrap();
        assert_eq!(read["kwargs"], Value::Table(task.kwargs.clone()));
        assert_eq!(read["wrappers"][0].as_str(), Some("tools:slow"));
        assert!(!read.contains_key("randomise"));
        task.randomise.mass = [0.5, 2.0];
        let read: Table = task.options_toml().parse().unwrap();
        assert_eq!(read["randomise"]["mass"], Value::Array(vec![0.5.into(), 2.0.into()]));
    }

    #[test]
    fn mistakes_are_named_with_what_is_expected() {
        for (key, value, words) in [
            ("task.kwargs", "5", "`task.kwargs`: expected a table"),
            ("task.kwargs.reward-type", "dense", "reward-type: expected names"),
            ("task.kwargs.", "1", "expected names"),
            ("task.kwargs.gain", "nan", "expected no NaN"),
            ("task.kwargs.gains", "[1.0, nan]", "expected no NaN"),
            ("task.kwargs.dense", "False", "expected a TOML value, such as false"),
            ("task.kwargs.limit", "None", "TOML has no None"),
            ("task.wrappers", "['tools']", "`task.wrappers` = tools: expected module:function"),
            ("task.wrappers", "['tools:a.b']", "expected module:function"),
            ("task.kwarg.gain", "1", "did you mean `task.kwargs`"),
            ("task.reward_type", "dense", "unknown key `task.reward_type`"),
        ] {
            let error = layered(&[(key, value)]).unwrap_err().to_string();
            assert!(error.contains(words), "{key} = {value}: {error}");
        }
    }
}
