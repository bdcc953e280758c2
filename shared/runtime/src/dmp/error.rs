//! Errors of a DMP or a demonstration.

use thiserror::Error;

/// Why a DMP cannot be built, or cannot imitate a demonstration.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DmpError {
    /// A parameter out of range.
    #[error("{name}: expected {expected}, got {got}")]
    Parameter {
        /// Name of the parameter in the configuration.
        name: &'static str,
        /// The valid range.
        expected: String,
        /// The actual value.
        got: String,
    },
    /// A slice of the wrong length.
    #[error("{name}: expected {expected} values, got {got}")]
    Shape {
        /// Name of the slice.
        name: &'static str,
        /// Expected length.
        expected: usize,
        /// Actual length.
        got: usize,
    },
    /// A value that is infinite or not a number.
    #[error("{name}[{index}]: expected a finite number, got {got}")]
    NotFinite {
        /// Name of the slice.
        name: &'static str,
        /// Index in the slice.
        index: usize,
        /// The actual value.
        got: f64,
    },
    /// Goal and start coincide. With goal scaling the forcing term is then zero for all weights.
    #[error("goal {goal} and start {start} coincide: forcing_scaling = \"goal\" cannot imitate")]
    GoalEqualsStart {
        /// The demonstration's goal.
        goal: f64,
        /// The demonstration's start.
        start: f64,
    },
    /// The demonstration does not determine every weight: it has too few samples, or the basis
    /// functions are too similar.
    #[error(
        "weight {weight} is not determined by the demonstration: use fewer basis functions \
             or more integration steps"
    )]
    RankDeficient {
        /// Index of the first such weight.
        weight: usize,
    },
}

impl DmpError {
    /// Returns a [`DmpError::Parameter`] unless `accepted` holds.
    pub(crate) fn parameter(
        accepted: bool,
        name: &'static str,
        expected: impl FnOnce() -> String,
        got: impl ToString,
    ) -> Result<(), Self> {
        if accepted {
            return Ok(());
        }
        Err(Self::Parameter { name, expected: expected(), got: got.to_string() })
    }

    /// Returns a [`DmpError::Shape`] if `values` is not `expected` long, or a
    /// [`DmpError::NotFinite`] if a value is not finite.
    pub(crate) fn values(name: &'static str, values: &[f64], expected: usize) -> Result<(), Self> {
        if values.len() != expected {
            return Err(Self::Shape { name, expected, got: values.len() });
        }
        match values.iter().position(|value| !value.is_finite()) {
            Some(index) => Err(Self::NotFinite { name, index, got: values[index] }),
            None => Ok(()),
        }
    }
}
