//! Checks of single values.

use std::fmt::Display;

use thiserror::Error;

/// A value out of range, or one that conflicts with another value.
#[derive(Debug, Error, PartialEq)]
#[error("`{key}` = {got}: {expected}")]
pub struct RangeError {
    /// The dotted key.
    pub key: &'static str,
    /// The condition that the value must meet.
    pub expected: String,
    /// The rejected value.
    pub got: String,
}

/// Rejects the value `got` of `key` unless it `fits`. `expected` completes "expected ...".
///
/// # Errors
/// If it does not fit.
pub fn range(
    key: &'static str,
    got: impl Display,
    fits: bool,
    expected: impl FnOnce() -> String,
) -> Result<(), RangeError> {
    if fits {
        return Ok(());
    }
    Err(RangeError { key, expected: format!("expected {}", expected()), got: got.to_string() })
}
