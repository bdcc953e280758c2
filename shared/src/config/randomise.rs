//! Physics and delays that an environment draws anew for each episode.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::RangeError;

/// Limits of the factors, which exclude a mass of zero.
const FACTOR_MIN: f64 = 0.01;
const FACTOR_MAX: f64 = 100.0;
/// Larger offsets are probably a typo.
const OFFSET_M_MAX: f64 = 10.0;
/// A later action has little to do with its observation.
const DELAY_STEPS_MAX: u32 = 100;

/// Ranges `[low, high]` from which each episode draws its own physics and delays, uniformly. With
/// the defaults, nothing is drawn (docs/environments.md).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RandomiseConfig {
    /// Factors of each body's mass and inertia, one for each body.
    pub mass: [f64; 2],
    /// Factor of all friction coefficients.
    pub friction: [f64; 2],
    /// Factors of each joint's damping, including the velocity gain of a position servo, one for
    /// each joint.
    pub damping: [f64; 2],
    /// Factors of each object's size, one for each object; its mass is unchanged. Objects are
    /// bodies with a free joint as their only joint.
    pub object_size: [f64; 2],
    /// Offsets of each object's start position along x and y \[m\].
    pub start_pose: [f64; 2],
    /// Environment steps by which actions take effect later.
    pub action_delay_steps: [u32; 2],
    /// Environment steps by which observations arrive later.
    pub observation_delay_steps: [u32; 2],
}

impl Default for RandomiseConfig {
    fn default() -> Self {
        Self {
            mass: [1.0; 2],
            friction: [1.0; 2],
            damping: [1.0; 2],
            object_size: [1.0; 2],
            start_pose: [0.0; 2],
            action_delay_steps: [0; 2],
            observation_delay_steps: [0; 2],
        }
    }
}

impl RandomiseConfig {
    /// Returns true if every episode is the model's own.
    #[must_use]
    pub fn is_nominal(&self) -> bool {
        *self == Self::default()
    }

    /// Checks every range; only the environment knows which keys it supports.
    pub(super) fn check(&self) -> Result<(), RangeError> {
        for (key, range) in [
            ("task.randomise.mass", self.mass),
            ("task.randomise.friction", self.friction),
            ("task.randomise.damping", self.damping),
            ("task.randomise.object_size", self.object_size),
        ] {
            check(key, range, [FACTOR_MIN, FACTOR_MAX])?;
        }
        check("task.randomise.start_pose", self.start_pose, [-OFFSET_M_MAX, OFFSET_M_MAX])?;
        let delays = [0, DELAY_STEPS_MAX];
        check("task.randomise.action_delay_steps", self.action_delay_steps, delays)?;
        check("task.randomise.observation_delay_steps", self.observation_delay_steps, delays)
    }
}

/// Checks that a range is not empty and within `limits`; NaN is in no range.
fn check<T: PartialOrd + std::fmt::Debug>(
    key: &'static str,
    range: [T; 2],
    limits: [T; 2],
) -> Result<(), RangeError> {
    if limits[0] <= range[0] && range[0] <= range[1] && range[1] <= limits[1] {
        return Ok(());
    }
    let [low, high] = limits;
    let expected = format!("expected [low, high], low <= high, from {low:?} to {high:?}");
    Err(RangeError { key, expected, got: format!("{range:?}") })
}

#[cfg(test)]
mod tests {
    use super::super::{ConfigError, ExperimentConfig, Layers, Limits};

    fn layered(key: &str, value: &str) -> Result<ExperimentConfig, ConfigError> {
        let mut layers = Layers::new();
        layers.set("--set", &format!("task.randomise.{key}"), value)?;
        layers.finish()?.resolve(Limits { cores: 2 })
    }

    #[test]
    fn ranges_are_read_with_whole_numbers_too() {
        let config = layered("mass", "[0.5, 2]").unwrap();
        assert_eq!(config.task.randomise.mass, [0.5, 2.0]);
        assert!(!config.task.randomise.is_nominal());
        assert!(layered("friction", "[1, 1]").unwrap().task.randomise.is_nominal());
        let config = layered("action_delay_steps", "[0, 2]").unwrap();
        assert_eq!(config.task.randomise.action_delay_steps, [0, 2]);
    }

    #[test]
    fn mistakes_are_named_with_the_limits() {
        for (key, value, words) in [
            ("mass", "[0.0, 1.0]", "`task.randomise.mass` = [0.0, 1.0]: expected [low, high]"),
            ("friction", "[2.0, 1.0]", "low <= high, from 0.01 to 100.0"),
            ("damping", "[nan, 1.0]", "task.randomise.damping"),
            ("object_size", "[1.0, inf]", "task.randomise.object_size"),
            ("start_pose", "[-0.02, 20.0]", "from -10.0 to 10.0"),
            ("action_delay_steps", "[0, 101]", "from 0 to 100"),
            ("observation_delay_steps", "[2, 1]", "task.randomise.observation_delay_steps"),
            ("mass", "2.0", "mass"),
            ("mass", "[1.0]", "mass"),
            ("action_delay_steps", "[0, 1.5]", "action_delay_steps"),
            ("masses", "[1.0, 2.0]", "did you mean `task.randomise.mass`"),
        ] {
            let error = layered(key, value).unwrap_err().to_string();
            assert!(error.contains(words), "{key} = {value}: {error}");
        }
    }
}
