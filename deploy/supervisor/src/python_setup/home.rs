//! Finds this program's Python package: in a clone of the project, or where pip installed both.

use std::path::PathBuf;

use anyhow::Result;
use dmprl_actors::python_env::{HostPython, host};
use dmprl_run::project;

use super::{
    declared::SIMULATION,
    ensure::{State, ensure, ensure_installed, state},
    environment::PythonEnvironment,
    paths::{LOCK, PACKAGE, USER_PACKAGES, VENV},
};

/// Location of the package `dmprl` and of an environment that can import it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Home {
    /// The project's directory, with `envs_py` and `.venv`, which is created on demand.
    Clone(PathBuf),
    /// The Python that runs this program, where pip installed program and package. It belongs to
    /// its user: dmprl never recreates it, and installs there only what a command needs or its user
    /// adds.
    Installed(&'static HostPython),
}

impl Home {
    /// Returns the Python that runs this program, or else the project's directory.
    ///
    /// # Errors
    /// Neither exists.
    pub fn find() -> Result<Self> {
        match host() {
            Some(host) => Ok(Self::Installed(host)),
            None => project::root().map(Self::Clone),
        }
    }

    /// Ensures that there is an environment that can import the package.
    ///
    /// # Errors
    /// See [`ensure`].
    pub fn ensure(&self, progress: &dyn Fn(&str)) -> Result<PythonEnvironment> {
        match self {
            Self::Clone(root) => ensure(root, progress),
            Self::Installed(_) => ensure_installed(self, SIMULATION, progress),
        }
    }

    /// Inspects the environment, without changes and without waiting.
    #[must_use]
    pub fn state(&self) -> State {
        match self {
            Self::Clone(root) => state(root),
            Self::Installed(host) if host.has_extra(SIMULATION) => State::Ready,
            Self::Installed(_) => State::Stale("no MuJoCo and Gymnasium, or old ones".to_owned()),
        }
    }

    /// Directory of the environment, which may not exist yet.
    #[must_use]
    pub fn venv(&self) -> PathBuf {
        match self {
            Self::Clone(root) => root.join(VENV),
            Self::Installed(host) => host.prefix.clone(),
        }
    }

    /// Directory that other interpreters need on their path for `import dmprl`.
    #[must_use]
    pub fn package_path(&self) -> PathBuf {
        match self {
            Self::Clone(root) => root.join(PACKAGE),
            Self::Installed(host) => host.packages.clone(),
        }
    }

    /// Path of the lock for changes of the environment.
    pub(super) fn lock(&self) -> PathBuf {
        match self {
            Self::Clone(root) => root.join(LOCK),
            Self::Installed(host) => host.prefix.join(LOCK),
        }
    }

    /// Path of the list of packages that a user added.
    pub(super) fn user_packages(&self) -> PathBuf {
        match self {
            Self::Clone(root) => root.join(USER_PACKAGES),
            Self::Installed(host) => host.prefix.join(USER_PACKAGES),
        }
    }

    /// Path of the file with the package's requirements.
    pub(super) fn requirements(&self) -> PathBuf {
        match self {
            Self::Clone(root) => root.join(PACKAGE).join("pyproject.toml"),
            Self::Installed(host) => host.metadata.clone(),
        }
    }
}
