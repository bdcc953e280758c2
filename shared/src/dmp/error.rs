//! What can be wrong with a DMP or a demonstration.

use thiserror::Error;

/// Why a DMP cannot be built, or cannot imitate a demonstration.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DmpError {
    /// A parameter outside the range in which the equations make sense.
    #[error("{name}: expected {expected}, got {got}")]
    Parameter {
        /// The parameter, as the configuration calls it.
        name: &'static str,
        /// The range.
        expected: String,
        /// The value.
        got: String,
    },
    /// A slice of the wrong length.
    #[error("{name}: expected {expected} values, got {got}")]
    Shape {
        /// The slice.
        name: &'static str,
        /// Its length, had it fitted.
        expected: usize,
        /// Its length.
        got: usize,
    },
    /// A value that is infinite or not a number.
    #[error("{name}[{index}]: expected a finite number, got {got}")]
    NotFinite {
        /// The slice.
        name: &'static str,
        /// Where in it.
        index: usize,
        /// The value.
        got: f64,
    },
    /// With goal scaling the forcing term vanishes when goal and start coincide, so that no
    /// weights can shape the motion.
    #[error("goal {goal} and start {start} coincide: forcing_scaling = \"goal\" cannot imitate")]
    GoalEqualsStart {
        /// The demonstration's goal.
        goal: f64,
        /// The demonstration's start.
        start: f64,
    },
    /// Too few samples, or basis functions too alike, to determine every weight.
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
    /// A [`DmpError::Parameter`], if `accepted` does not hold.
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

    /// A [`DmpError::Shape`], if `values` is not `expected` long; else a [`DmpError::NotFinite`],
    /// if one of them is not finite.
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
