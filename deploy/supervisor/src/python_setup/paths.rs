//! Names of files and folders, relative to the project's root.

/// The virtual environment.
pub(super) const VENV: &str = ".venv";
/// Lock file beside `.venv`: it must survive when `.venv` is recreated.
pub(super) const LOCK: &str = ".venv.lock";
/// List of the packages that a user added, beside `.venv` for the same reason.
pub(super) const USER_PACKAGES: &str = ".venv-packages.txt";
/// The Python package.
pub(super) const PACKAGE: &str = "envs_py";
