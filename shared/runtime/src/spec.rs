//! Sizes, bounds and timing of an environment.

use std::fmt::Debug;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::goal_rule::{GoalRule, GoalRuleError};

/// Sizes, bounds and timing of one environment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvSpec {
    /// Gymnasium id.
    pub id: String,
    /// Length O of an observation.
    pub observation_len: usize,
    /// Length A of an action.
    pub action_len: usize,
    /// Lower bound of each action dimension; boxes need not be symmetric.
    pub action_low: Vec<f64>,
    /// Upper bound of each action dimension.
    pub action_high: Vec<f64>,
    /// Duration of one environment step \[s\]; 0 if the environment does not report it.
    pub control_dt_s: f64,
    /// Steps after which an episode is truncated; 0 if it never is.
    pub episode_steps: u32,
    /// Name of each entry of an observation, such as `achieved_goal[0]`. Empty if the entries have
    /// no names, as in files of older versions.
    #[serde(default)]
    pub observation_names: Vec<String>,
    /// Rewards for other goals, if the run uses hindsight and the environment follows a rule.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub goal_rule: Option<Box<GoalRule>>,
}

/// Why an environment cannot be used.
#[derive(Debug, Error)]
pub enum SpecError {
    /// A list of the wrong length.
    #[error("{id}: {name} has {got} entries, expected {expected}")]
    Length {
        /// Gymnasium id.
        id: String,
        /// Name of the field.
        name: &'static str,
        /// Expected length.
        expected: usize,
        /// Actual length.
        got: usize,
    },
    /// An action range that is not finite or is empty.
    #[error(
        "{id}: action dimension {dimension} is bounded by [{low}, {high}]; \
         expected finite, low < high"
    )]
    Bounds {
        /// Gymnasium id.
        id: String,
        /// Index of the action dimension.
        dimension: usize,
        /// Its lower bound.
        low: f64,
        /// Its upper bound.
        high: f64,
    },
    /// An invalid duration of a step. The duration scales the policy's start velocity, and workers
    /// report it as JSON, which cannot represent NaN or infinity.
    #[error(
        "{id}: the duration of a step (the environment's attribute dt) is {got} s; expected a \
         finite number, 0 or more (0: unknown)"
    )]
    Duration {
        /// Gymnasium id.
        id: String,
        /// Reported duration \[s\].
        got: f64,
    },
    /// A goal rule that does not fit the observation.
    #[error("{id}: {cause}")]
    GoalRule {
        /// Gymnasium id.
        id: String,
        /// The reason.
        #[source]
        cause: GoalRuleError,
    },
}

impl EnvSpec {
    /// Returns the spec of an environment whose observations have no names, and whose goals follow
    /// no rule. `action_bounds` are the lower and upper bound of each action dimension.
    #[must_use]
    pub fn new(
        id: &str,
        observation_len: usize,
        action_bounds: &[(f64, f64)],
        control_dt_s: f64,
        episode_steps: u32,
    ) -> Self {
        let (action_low, action_high): (Vec<_>, Vec<_>) = action_bounds.iter().copied().unzip();
        Self {
            id: id.into(),
            observation_len,
            action_len: action_bounds.len(),
            action_low,
            action_high,
            control_dt_s,
            episode_steps,
            observation_names: Vec::new(),
            goal_rule: None,
        }
    }

    /// Checks lengths, bounds and the duration of a step.
    ///
    /// # Errors
    /// `Length`, `Bounds`, `Duration` or `GoalRule`, naming the field or dimension.
    pub fn check(&self) -> Result<(), SpecError> {
        let names_len = match self.observation_names.len() {
            0 => self.observation_len,
            named => named,
        };
        let lengths = [
            ("action_low", self.action_low.len(), self.action_len),
            ("action_high", self.action_high.len(), self.action_len),
            ("observation", self.observation_len.min(1), 1),
            ("action", self.action_len.min(1), 1),
            ("observation_names", names_len, self.observation_len),
        ];
        for (name, got, expected) in lengths {
            if got != expected {
                return Err(SpecError::Length { id: self.id.clone(), name, expected, got });
            }
        }
        for (dimension, (&low, &high)) in self.action_low.iter().zip(&self.action_high).enumerate()
        {
            if !(low.is_finite() && high.is_finite() && low < high) {
                return Err(SpecError::Bounds { id: self.id.clone(), dimension, low, high });
            }
        }
        if !(self.control_dt_s.is_finite() && self.control_dt_s >= 0.0) {
            return Err(SpecError::Duration { id: self.id.clone(), got: self.control_dt_s });
        }
        if let Some(rule) = &self.goal_rule {
            rule.check(self.observation_len)
                .map_err(|cause| SpecError::GoalRule { id: self.id.clone(), cause })?;
        }
        Ok(())
    }

    /// Returns the fields in which `got` differs, or `None` if both describe the same environment.
    /// Names of observation entries are ignored if only one side has them, or a different length
    /// says enough. Goal rules are ignored, because only runs with hindsight look for one.
    #[must_use]
    pub fn difference(&self, got: &Self) -> Option<String> {
        let names = self.observation_names.iter().zip(&got.observation_names);
        let renamed = names.enumerate().find(|(_, (expected, got))| expected != got);
        let renamed = renamed.filter(|_| self.observation_len == got.observation_len);
        let fields = [
            field("id", &self.id, &got.id),
            field("observation_len", &self.observation_len, &got.observation_len),
            renamed.and_then(|(at, (a, b))| field(&format!("observation_names[{at}]"), a, b)),
            field("action_len", &self.action_len, &got.action_len),
            field("action_low", &self.action_low, &got.action_low),
            field("action_high", &self.action_high, &got.action_high),
            field("control_dt_s", &self.control_dt_s, &got.control_dt_s),
            field("episode_steps", &self.episode_steps, &got.episode_steps),
        ];
        let differing: Vec<String> = fields.into_iter().flatten().collect();
        (!differing.is_empty()).then(|| differing.join("; "))
    }

    /// Returns the name of entry `index` of an observation, `observation[index]` if it has none.
    #[must_use]
    pub fn observation_name(&self, index: usize) -> String {
        let name = self.observation_names.get(index).cloned();
        name.unwrap_or_else(|| format!("observation[{index}]"))
    }
}

/// Returns `name: expected …, got …` if the values differ.
fn field<T: PartialEq + Debug>(name: &str, expected: &T, got: &T) -> Option<String> {
    (expected != got).then(|| format!("{name}: expected {expected:?}, got {got:?}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Written by version 0.1.0.
    const OLDER: &str = r#"{"id": "Test-v0", "observation_len": 2, "action_len": 1,
        "action_low": [-1.0], "action_high": [1.0], "control_dt_s": 0.02, "episode_steps": 50}"#;

    #[test]
    fn spec_without_names_equals_the_same_spec_with_names() {
        let older: EnvSpec = serde_json::from_str(OLDER).unwrap();
        older.check().unwrap();
        assert_eq!(older.observation_name(1), "observation[1]");
        let names = ["angle", "speed"].map(str::to_owned).to_vec();
        let newer = EnvSpec { observation_names: names, ..older.clone() };
        newer.check().unwrap();
        assert_eq!(newer.observation_name(1), "speed");
        assert_eq!((newer.difference(&older), older.difference(&newer)), (None, None));
        let other = EnvSpec { observation_names: vec!["x".into(), "y".into()], ..older.clone() };
        assert!(newer.difference(&other).unwrap().starts_with("observation_names["));
        let other = EnvSpec { episode_steps: 51, control_dt_s: 0.5, ..older.clone() };
        let expected = "control_dt_s: expected 0.02, got 0.5; episode_steps: expected 50, got 51";
        assert_eq!(older.difference(&other).unwrap(), expected);
    }

    #[test]
    fn wrong_number_of_names_is_rejected() {
        let older: EnvSpec = serde_json::from_str(OLDER).unwrap();
        let spec = EnvSpec { observation_names: vec!["angle".into()], ..older };
        let message = spec.check().unwrap_err().to_string();
        assert_eq!(message, "Test-v0: observation_names has 1 entries, expected 2");
    }

    #[test]
    fn invalid_step_duration_is_rejected() {
        let older: EnvSpec = serde_json::from_str(OLDER).unwrap();
        for (got, shown) in [(f64::NAN, "NaN"), (f64::INFINITY, "inf"), (-1.0, "-1")] {
            let spec = EnvSpec { control_dt_s: got, ..older.clone() };
            let message = spec.check().unwrap_err().to_string();
            let start = "Test-v0: the duration of a step (the environment's attribute dt) is ";
            assert!(message.starts_with(&format!("{start}{shown} s; expected")), "{message}");
        }
        EnvSpec { control_dt_s: 0.0, ..older }.check().unwrap();
    }
}
