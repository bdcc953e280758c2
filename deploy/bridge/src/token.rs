//! The run's token, a secret that other hosts need.

use std::path::Path;

use dmprl_run::secret_file;
use subtle::ConstantTimeEq;

const REMEDY: &str = "copy bridge.token of the run's directory from the learner's host";

/// Reads a run's token; creates it if it does not exist.
///
/// # Errors
/// The file can be read by others, contains no valid token, or cannot be created.
pub fn ensure(path: &Path) -> anyhow::Result<String> {
    secret_file::ensure(path, REMEDY)
}

/// Reads a run's token.
///
/// # Errors
/// Wrong use: the file does not exist, can be read by others, or its content is too short or too
/// long.
pub fn read(path: &Path) -> anyhow::Result<String> {
    secret_file::read(path, REMEDY)
}

/// Compares two secrets in constant time, so that the time does not reveal where they differ.
#[must_use]
pub fn equal(one: &str, other: &str) -> bool {
    one.as_bytes().ct_eq(other.as_bytes()).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_same_token_is_equal() {
        let token = "0123456789abcdef";
        assert!(equal(token, token));
        assert!(!equal(token, &token[1..]) && !equal(token, &token.replace('0', "x")));
    }
}
