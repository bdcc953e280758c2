//! Installs optional parts of the Python package when a command first needs them.

use anyhow::Result;

use super::{ensure::ensure_installed, environment::PythonEnvironment, home::Home};

/// Ensures that the environment of `home` has the package, as [`Home::ensure`] does, and the
/// requirements of its optional part `extra`: the locked versions, or, in an environment into which
/// pip installed this program, versions in the declared ranges.
///
/// A file in the environment records the installed requirements, so that later starts neither run
/// pip nor need a network.
///
/// # Errors
/// See [`Home::ensure`]; also if the package has no part `extra`.
pub fn ensure_extra(
    home: &Home,
    extra: &str,
    progress: &dyn Fn(&str),
) -> Result<PythonEnvironment> {
    home.ensure(progress)?;
    ensure_installed(home, extra, progress)
}
