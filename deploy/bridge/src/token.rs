//! The run's token, a secret that other hosts need. It is never sent: [`crate::keys`].

use std::path::Path;

use dmprl_run::secret_file;

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
