//! The search space: configuration keys, each with a range or a list of values.

use dmprl_shared::config::{ExperimentConfig, Layers};
use serde_json::json;
use toml::{Table, Value};

use super::file::flatten;

/// Tables that must be the same for all trials, so that their results are comparable.
const NOT_SEARCHED: [&str; 3] = ["run", "task", "evaluation"];
/// Keys of a range.
const RANGE_KEYS: [&str; 3] = ["low", "high", "log"];

/// A configuration key and its possible values.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// Dotted configuration key.
    pub key: String,
    /// Possible values.
    pub domain: Domain,
}

/// Possible values of a parameter.
#[derive(Debug, Clone, PartialEq)]
pub enum Domain {
    /// Numbers from `low` to `high`, inclusive.
    Float {
        /// Lower bound.
        low: f64,
        /// Upper bound.
        high: f64,
        /// If true, samples the logarithm uniformly.
        log: bool,
    },
    /// Integers from `low` to `high`, inclusive, for a key that holds an integer.
    Integer {
        /// Lower bound.
        low: i64,
        /// Upper bound.
        high: i64,
        /// If true, samples the logarithm uniformly.
        log: bool,
    },
    /// One of these values, without an order.
    Choice(Vec<Value>),
}

impl Domain {
    /// Returns the extreme values: the ends of a range, or all values of a list. If these are
    /// valid, all values are.
    #[must_use]
    pub fn extremes(&self) -> Vec<Value> {
        match self {
            Self::Float { low, high, .. } => vec![Value::Float(*low), Value::Float(*high)],
            Self::Integer { low, high, .. } => vec![Value::Integer(*low), Value::Integer(*high)],
            Self::Choice(values) => values.clone(),
        }
    }

    /// Describes the values in a few words.
    #[must_use]
    pub fn words(&self) -> String {
        let scale = |log: bool| if log { ", logarithmic" } else { "" };
        match self {
            Self::Float { low, high, log } => {
                format!("{} to {}{}", Value::Float(*low), Value::Float(*high), scale(*log))
            }
            Self::Integer { low, high, log } => format!("{low} to {high}, integers{}", scale(*log)),
            Self::Choice(values) => {
                values.iter().map(ToString::to_string).collect::<Vec<_>>().join(" or ")
            }
        }
    }

    /// Converts a value that Optuna suggested.
    pub(super) fn value(&self, json: &serde_json::Value) -> Option<Value> {
        match self {
            Self::Float { .. } => json.as_f64().map(Value::Float),
            Self::Integer { .. } => json.as_i64().map(Value::Integer),
            Self::Choice(values) => values.iter().find(|value| as_json(value) == *json).cloned(),
        }
    }

    /// Returns the value in the type of this domain if it is one of its values.
    fn contains(&self, value: &Value) -> Option<Value> {
        let within = match (self, value) {
            (Self::Float { low, high, .. }, Value::Float(x)) => (low..=high).contains(&x),
            (Self::Float { low, high, .. }, Value::Integer(x)) => {
                let x = *x as f64;
                return (*low..=*high).contains(&x).then_some(Value::Float(x));
            }
            (Self::Integer { low, high, .. }, Value::Integer(x)) => (low..=high).contains(&x),
            (Self::Choice(values), value) => values.contains(value),
            _ => false,
        };
        within.then(|| value.clone())
    }
}

impl Parameter {
    /// Formats the parameter for `dmprl.search`.
    pub(super) fn json(&self) -> serde_json::Value {
        let key = &self.key;
        match &self.domain {
            Domain::Float { low, high, log } => {
                json!({ "key": key, "kind": "float", "low": low, "high": high, "log": log })
            }
            Domain::Integer { low, high, log } => {
                json!({ "key": key, "kind": "int", "low": low, "high": high, "log": log })
            }
            Domain::Choice(values) => {
                json!({ "key": key, "choices": values.iter().map(as_json).collect::<Vec<_>>() })
            }
        }
    }
}

/// Converts a value to JSON. Optuna's choices are scalars, so a list becomes text.
pub(super) fn as_json(value: &Value) -> serde_json::Value {
    match value {
        Value::String(text) => json!(text),
        Value::Integer(number) => json!(number),
        Value::Float(number) => json!(number),
        Value::Boolean(truth) => json!(truth),
        other => json!(other.to_string()),
    }
}

/// Parses `[search.space]` into parameters, sorted by key.
pub(super) fn parse(space: &Table) -> Result<Vec<Parameter>, String> {
    let defaults =
        Table::try_from(ExperimentConfig::default()).map_err(|error| error.to_string())?;
    let defaults = flatten(&defaults);
    let mut parameters = Vec::new();
    for (key, value) in entries(space) {
        let refused = |what: String| format!("search.space.{key}: {what}");
        let table = key.split('.').next().unwrap_or_default();
        if NOT_SEARCHED.contains(&table) {
            return Err(refused(format!("all trials must have the same [{table}]")));
        }
        let Some((_, default)) = defaults.iter().find(|(known, _)| *known == key) else {
            let unknown = Layers::new().set("search.space", &key, "0").err();
            return Err(unknown.map_or_else(
                || refused("a table of keys; expected a single key".to_owned()),
                |error| error.to_string(),
            ));
        };
        let domain = match &value {
            Value::Array(values) => choice(values),
            Value::Table(range) => self::range(range, default),
            other => Err(format!("{other}; expected {{ low, high }} or a list of values")),
        };
        parameters.push(Parameter { domain: domain.map_err(refused)?, key });
    }
    if parameters.is_empty() {
        return Err("search.space: expected at least one configuration key".to_owned());
    }
    Ok(parameters)
}

/// Like [`flatten`], but a table with the keys of a range is one value.
fn entries(table: &Table) -> Vec<(String, Value)> {
    let is_range = |inner: &Table| RANGE_KEYS.iter().any(|key| inner.contains_key(*key));
    let mut entries = Vec::new();
    for (key, value) in table {
        match value {
            Value::Table(inner) if !is_range(inner) => entries.extend(
                self::entries(inner)
                    .into_iter()
                    .map(|(below, leaf)| (format!("{key}.{below}"), leaf)),
            ),
            leaf => entries.push((key.clone(), leaf.clone())),
        }
    }
    entries
}

fn choice(values: &[Value]) -> Result<Domain, String> {
    let Some(first) = values.first() else {
        return Err("an empty list; expected at least one value".to_owned());
    };
    if let Some(other) = values.iter().find(|value| !value.same_type(first)) {
        let types = (first.type_str(), other.type_str());
        return Err(format!(
            "{first} is of type {}, {other} of type {}; expected values of one type",
            types.0, types.1
        ));
    }
    for (index, value) in values.iter().enumerate() {
        if values[..index].contains(value) {
            return Err(format!("{value} is listed twice"));
        }
    }
    Ok(Domain::Choice(values.to_vec()))
}

fn range(range: &Table, default: &Value) -> Result<Domain, String> {
    if let Some(key) = range.keys().find(|key| !RANGE_KEYS.contains(&key.as_str())) {
        return Err(format!("unknown key `{key}`; expected low, high and log"));
    }
    let log = match range.get("log") {
        None => false,
        Some(Value::Boolean(log)) => *log,
        Some(other) => return Err(format!("log = {other}; expected true or false")),
    };
    let end = |name: &str| range.get(name).ok_or_else(|| format!("no `{name}`"));
    let (low, high) = (end("low")?, end("high")?);
    let number = |value: &Value| match value {
        Value::Integer(number) => Some(*number as f64),
        Value::Float(number) => Some(*number),
        _ => None,
    };
    let numbers = [low, high].map(number);
    let [Some(from), Some(to)] = numbers.map(|number| number.filter(|x| x.is_finite())) else {
        return Err(format!("low = {low}, high = {high}; expected finite numbers"));
    };
    if from >= to {
        return Err(format!("low = {low}, high = {high}; expected low below high"));
    }
    if log && from <= 0.0 {
        return Err(format!("low = {low} with log = true; expected more than 0"));
    }
    match (default, low, high) {
        (Value::Float(_), ..) => Ok(Domain::Float { low: from, high: to, log }),
        (Value::Integer(_), Value::Integer(low), Value::Integer(high)) => {
            Ok(Domain::Integer { low: *low, high: *high, log })
        }
        (Value::Integer(_), ..) => {
            Err(format!("low = {low}, high = {high}; expected integers, as the key's type"))
        }
        _ => Err(format!("the key is not a number ({default}); expected a list of values")),
    }
}

/// Parses a point of `[[search.first]]`.
pub(super) fn point(parameters: &[Parameter], table: &Table) -> Result<Table, String> {
    let mut point = Table::new();
    for (key, value) in flatten(table) {
        let parameter = parameters.iter().find(|parameter| parameter.key == key);
        let parameter =
            parameter.ok_or_else(|| format!("search.first.{key}: not in search.space"))?;
        let value = parameter.domain.contains(&value).ok_or_else(|| {
            format!("search.first.{key} = {value}: expected {}", parameter.domain.words())
        })?;
        point.insert(key, value);
    }
    Ok(point)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn space(text: &str) -> Result<Vec<Parameter>, String> {
        parse(&text.parse().unwrap())
    }

    #[test]
    fn a_range_has_the_type_of_its_key_and_a_list_that_of_its_values() {
        let parameters = space(
            "'algorithm.critic_learning_rate' = { low = 1e-4, high = 1, log = true }
             dmp.basis_count = { low = 3, high = 7 }
             exploration.kind = ['gaussian', 'pink']
             [policy]
             hidden = [[32, 32], [64]]",
        )
        .unwrap();
        let domain = |key: &str| {
            parameters.iter().find(|parameter| parameter.key == key).unwrap().domain.clone()
        };
        let rate = Domain::Float { low: 1e-4, high: 1.0, log: true };
        assert_eq!(domain("algorithm.critic_learning_rate"), rate);
        let count = Domain::Integer { low: 3, high: 7, log: false };
        assert_eq!(domain("dmp.basis_count"), count);
        let kinds = domain("exploration.kind");
        assert_eq!(kinds.value(&json!("pink")), Some(Value::String("pink".to_owned())));
        assert_eq!(kinds.value(&json!("brown")), None);
        let hidden = domain("policy.hidden");
        for value in hidden.extremes() {
            assert_eq!(hidden.value(&as_json(&value)), Some(value));
        }
        assert_eq!(parameters.len(), 4);
    }

    #[test]
    fn mistakes_name_their_key() {
        for (text, words) in [
            ("", "at least one"),
            ("algorithm.bach_size = [1]", "did you mean `algorithm.batch_size`"),
            ("algorithm = [1]", "algorithm"),
            ("run.seed = [1, 2]", "search.space.run.seed: all trials"),
            ("evaluation.first_seed = [1]", "search.space.evaluation.first_seed"),
            ("task.kwargs.reward_type = ['dense']", "search.space.task.kwargs.reward_type: all"),
            ("dmp.alpha_y = { low = 3, high = 1 }", "search.space.dmp.alpha_y: low = 3, high = 1"),
            ("dmp.alpha_y = { low = 3, high = 3 }", "low below high"),
            ("dmp.alpha_y = { low = 0, high = 3, log = true }", "more than 0"),
            ("dmp.alpha_y = { low = 1, high = inf }", "finite"),
            ("dmp.alpha_y = { low = 1 }", "no `high`"),
            ("dmp.alpha_y = { low = 1, high = 2, lag = true }", "unknown key `lag`"),
            ("dmp.alpha_y = { low = 1, high = 2, log = 1 }", "true or false"),
            ("dmp.alpha_y = 3", "a list of values"),
            ("dmp.alpha_y = []", "an empty list"),
            ("dmp.alpha_y = [1.0, 'a']", "one type"),
            ("dmp.alpha_y = [1.0, 1.0]", "twice"),
            ("dmp.basis_count = { low = 1.5, high = 3 }", "expected integers"),
            ("exploration.kind = { low = 1, high = 3 }", "is not a number"),
        ] {
            let error = space(text).unwrap_err();
            assert!(error.contains(words), "{text}: {error}");
        }
    }

    #[test]
    fn first_points_outside_the_space_are_rejected() {
        let parameters =
            space("dmp.alpha_y = { low = 1, high = 9 }\nexploration.kind = ['pink']").unwrap();
        let point = |text: &str| point(&parameters, &text.parse().unwrap());
        assert_eq!(point("dmp.alpha_y = 2").unwrap()["dmp.alpha_y"], Value::Float(2.0));
        assert!(point("dmp.alpha_y = 10").unwrap_err().contains("1.0 to 9.0"));
        assert!(point("exploration.kind = 'brown'").unwrap_err().contains("\"pink\""));
        assert!(point("dmp.alpha_x = 1").unwrap_err().contains("not in search.space"));
    }
}
