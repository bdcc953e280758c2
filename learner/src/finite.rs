//! Finds parameters that are NaN or infinite, before they are published or written, and when they
//! are read.

use thiserror::Error;

/// Bits of the exponent, all of which are set in NaN and infinity.
const EXPONENT: u32 = 0x7f80_0000;

/// A parameter that is NaN or infinite.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("{name}[{index}] is {value}, expected a finite number")]
pub struct NotFiniteParameter {
    /// Name of the parameters, such as `critic.network`.
    pub name: String,
    /// Index of the parameter.
    pub index: usize,
    /// Its value.
    pub value: f32,
}

/// Checks that all values are finite. `name` returns the name of the values.
///
/// # Errors
/// The first value that is NaN or infinite.
pub fn check(values: &[f32], name: impl FnOnce() -> String) -> Result<(), NotFiniteParameter> {
    let is_unbounded = |value: &f32| value.to_bits() & EXPONENT == EXPONENT;
    // Without an early exit, so that it is vectorised.
    if !values.iter().fold(false, |found, value| found | is_unbounded(value)) {
        return Ok(());
    }
    let found = values.iter().enumerate().find(|(_, value)| is_unbounded(value));
    found.map_or(Ok(()), |(index, &value)| Err(NotFiniteParameter { name: name(), index, value }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_value_that_is_not_finite_is_named() {
        let mut values = vec![f32::MAX, f32::MIN, f32::MIN_POSITIVE / 2.0, -0.0];
        assert_eq!(check(&values, || unreachable!()), Ok(()));
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            values[2] = bad;
            let error = check(&values, || "critic.network".to_owned()).unwrap_err();
            assert_eq!((error.index, error.value.to_bits()), (2, bad.to_bits()));
        }
        let message = check(&values, || "critic.network".to_owned()).unwrap_err().to_string();
        assert_eq!(message, "critic.network[2] is -inf, expected a finite number");
    }
}
