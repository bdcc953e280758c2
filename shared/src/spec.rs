//! What an environment is, as far as learner and policy care.

use serde::{Deserialize, Serialize};
use thiserror::Error;

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
    /// Duration of one environment step [s]; 0 when the environment does not say.
    pub control_dt_s: f64,
    /// Steps after which an episode is truncated; 0 when it never is.
    pub episode_steps: u32,
}

/// Why an environment cannot be used.
#[derive(Debug, Error)]
pub enum SpecError {
    /// Lengths that do not fit each other.
    #[error("{id}: {name} has {got} entries, expected {expected}")]
    Length {
        /// Gymnasium id.
        id: String,
        /// Which field.
        name: &'static str,
        /// Expected length.
        expected: usize,
        /// Actual length.
        got: usize,
    },
    /// A bound that is infinite, NaN or empty.
    #[error(
        "{id}: action dimension {dimension} is bounded by [{low}, {high}]; \
         expected finite, low < high"
    )]
    Bounds {
        /// Gymnasium id.
        id: String,
        /// Which action dimension.
        dimension: usize,
        /// Its lower bound.
        low: f64,
        /// Its upper bound.
        high: f64,
    },
}

impl EnvSpec {
    /// Checks lengths and bounds.
    ///
    /// # Errors
    /// `Length` or `Bounds`, naming the field or dimension.
    pub fn check(&self) -> Result<(), SpecError> {
        let lengths = [
            ("action_low", self.action_low.len(), self.action_len),
            ("action_high", self.action_high.len(), self.action_len),
            ("observation", self.observation_len.min(1), 1),
            ("action", self.action_len.min(1), 1),
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
        Ok(())
    }
}
