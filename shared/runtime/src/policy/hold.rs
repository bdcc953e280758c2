//! The command that holds a robot, in the robot's own terms.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::spec::EnvSpec;

const POSITION: &str = "position";
const ZERO_VELOCITY: &str = "zero-velocity";
const ZERO_TORQUE: &str = "zero-torque";

/// The command that holds a robot. A policy has none by default, because the same numbers hold one
/// robot and move another.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Hold {
    /// The robot takes positions. It moves to this one and keeps it.
    Position {
        /// The position to keep, (A,) in the environment's units of an action.
        values: Vec<f64>,
    },
    /// The robot takes velocities, or displacements per control step. All are 0, so it stops where
    /// it is.
    ZeroVelocity,
    /// The robot takes torques. All are 0, so an arm without gravity compensation falls.
    ZeroTorque,
}

/// Why a hold is invalid.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum HoldError {
    /// A text that is no hold.
    #[error(
        "hold is `{0}`: expected zero-velocity, zero-torque or position=V,V,… (one per action)"
    )]
    Text(String),
    /// A position with the wrong number of values.
    #[error("the hold has {got} values, expected {expected}, one per action dimension")]
    Length {
        /// Number of action dimensions, A.
        expected: usize,
        /// Number of values.
        got: usize,
    },
    /// A value outside the bounds of an action.
    #[error("the hold of action dimension {dimension} is {got}: expected {low} to {high}")]
    Bounds {
        /// Index of the action dimension.
        dimension: usize,
        /// The value.
        got: f64,
        /// Lower bound of the action.
        low: f64,
        /// Upper bound of the action.
        high: f64,
    },
}

impl Hold {
    /// Returns the action that holds the robot, (A,), in the environment's units.
    ///
    /// # Errors
    /// `Length` if a position does not have A values; `Bounds` if a value is not a possible action.
    pub fn action(&self, spec: &EnvSpec) -> Result<Vec<f64>, HoldError> {
        let action = match self {
            Self::Position { values } => values.clone(),
            Self::ZeroVelocity | Self::ZeroTorque => vec![0.0; spec.action_len],
        };
        if action.len() != spec.action_len {
            return Err(HoldError::Length { expected: spec.action_len, got: action.len() });
        }
        for (dimension, &got) in action.iter().enumerate() {
            let (low, high) = (spec.action_low[dimension], spec.action_high[dimension]);
            // Also rejects NaN.
            if !(low..=high).contains(&got) {
                return Err(HoldError::Bounds { dimension, got, low, high });
            }
        }
        Ok(action)
    }
}

impl fmt::Display for Hold {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Position { values } => {
                let values: Vec<_> = values.iter().map(f64::to_string).collect();
                write!(formatter, "{POSITION}={}", values.join(","))
            }
            Self::ZeroVelocity => formatter.write_str(ZERO_VELOCITY),
            Self::ZeroTorque => formatter.write_str(ZERO_TORQUE),
        }
    }
}

impl FromStr for Hold {
    type Err = HoldError;

    /// Parses `zero-velocity`, `zero-torque` or `position=V,V,…`.
    fn from_str(text: &str) -> Result<Self, HoldError> {
        let invalid = || HoldError::Text(text.to_owned());
        match text.split_once('=') {
            None if text == ZERO_VELOCITY => Ok(Self::ZeroVelocity),
            None if text == ZERO_TORQUE => Ok(Self::ZeroTorque),
            Some((POSITION, list)) => {
                let values = list.split(',').map(|value| value.trim().parse());
                let values = values.collect::<Result<_, _>>().map_err(|_| invalid())?;
                Ok(Self::Position { values })
            }
            _ => Err(invalid()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec() -> EnvSpec {
        EnvSpec::new("Test-v0", 4, &[(-1.0, 1.0), (1.0, 4.0)], 0.05, 50)
    }

    #[test]
    fn hold_is_read_as_it_is_written() {
        let position = Hold::Position { values: vec![0.5, -2.0] };
        for (hold, text, json) in [
            (position, "position=0.5,-2", r#"{"kind":"position","values":[0.5,-2.0]}"#),
            (Hold::ZeroVelocity, "zero-velocity", r#"{"kind":"zero-velocity"}"#),
            (Hold::ZeroTorque, "zero-torque", r#"{"kind":"zero-torque"}"#),
        ] {
            assert_eq!(hold.to_string(), text);
            assert_eq!(text.parse(), Ok(hold.clone()));
            assert_eq!(serde_json::to_string(&hold).unwrap(), json);
            assert_eq!(serde_json::from_str::<Hold>(json).unwrap(), hold);
        }
        for text in ["", "0", "zero", "position", "position=", "position=a", "zero-torque=1"] {
            assert_eq!(text.parse::<Hold>(), Err(HoldError::Text(text.into())), "{text}");
        }
    }

    #[test]
    fn hold_that_is_no_possible_action_is_rejected() {
        let position = |values: &[f64]| Hold::Position { values: values.to_vec() };
        assert_eq!(position(&[0.5, 2.0]).action(&spec()), Ok(vec![0.5, 2.0]));
        for (hold, message) in [
            (position(&[0.0, 0.5]), "the hold of action dimension 1 is 0.5: expected 1 to 4"),
            (position(&[f64::NAN, 2.0]), "the hold of action dimension 0 is NaN: expected -1 to 1"),
            (position(&[0.0]), "the hold has 1 values, expected 2, one per action dimension"),
            (Hold::ZeroTorque, "the hold of action dimension 1 is 0: expected 1 to 4"),
        ] {
            assert_eq!(hold.action(&spec()).unwrap_err().to_string(), message);
        }
    }
}
