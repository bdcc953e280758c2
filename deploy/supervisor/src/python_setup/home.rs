//! Finds this program's Python package: in a clone of the project, or where pip installed both.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use dmprl_actors::python_env::LINKED_PYTHON;
use dmprl_run::project;

use super::{
    ensure::{State, ensure, state},
    environment::PythonEnvironment,
    paths::{LOCK, PACKAGE, USER_PACKAGES, VENV},
};

/// Location of the package `dmprl` and of an environment that can import it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Home {
    /// The project's directory, with `envs_py` and `.venv`, which is created on demand.
    Clone(PathBuf),
    /// The environment into which pip installed program and package. It belongs to its user: dmprl
    /// never recreates it, and installs there only what a command needs or its user adds.
    Installed(PythonEnvironment),
}

impl Home {
    /// Finds the environment into which this program was installed, or else the project's
    /// directory.
    ///
    /// # Errors
    /// Neither exists, or the path of this program cannot be found.
    pub fn find() -> Result<Self> {
        let program = std::env::current_exe().context("cannot find the path of this program")?;
        match installed(&program) {
            Some(environment) => Ok(Self::Installed(environment)),
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
            Self::Installed(environment) => Ok(environment.clone()),
        }
    }

    /// Inspects the environment, without changes and without waiting.
    #[must_use]
    pub fn state(&self) -> State {
        match self {
            Self::Clone(root) => state(root),
            Self::Installed(_) => State::Ready,
        }
    }

    /// Directory of the environment, which may not exist yet.
    #[must_use]
    pub fn venv(&self) -> PathBuf {
        match self {
            Self::Clone(root) => root.join(VENV),
            Self::Installed(environment) => environment.venv.clone(),
        }
    }

    /// Directory that other interpreters need on their path for `import dmprl`.
    #[must_use]
    pub fn package_path(&self) -> PathBuf {
        match self {
            Self::Clone(root) => root.join(PACKAGE),
            Self::Installed(environment) => site_packages(&environment.venv),
        }
    }

    /// Path of the lock for changes of the environment.
    pub(super) fn lock(&self) -> PathBuf {
        match self {
            Self::Clone(root) => root.join(LOCK),
            Self::Installed(environment) => environment.venv.join(LOCK),
        }
    }

    /// Path of the list of packages that a user added.
    pub(super) fn user_packages(&self) -> PathBuf {
        match self {
            Self::Clone(root) => root.join(USER_PACKAGES),
            Self::Installed(environment) => environment.venv.join(USER_PACKAGES),
        }
    }

    /// Path of the file with the package's requirements.
    pub(super) fn requirements(&self) -> PathBuf {
        match self {
            Self::Clone(root) => root.join(PACKAGE).join("pyproject.toml"),
            Self::Installed(environment) => metadata(&environment.venv),
        }
    }
}

/// Returns the environment whose `bin` contains `program`, if pip installed it there with the
/// package of the same version.
fn installed(program: &Path) -> Option<PythonEnvironment> {
    let bin = program.parent()?;
    let environment = PythonEnvironment::of(bin.parent()?.to_owned());
    let is_there = environment.executable.exists() && metadata(&environment.venv).is_file();
    (bin.file_name()? == "bin" && is_there).then_some(environment)
}

fn site_packages(prefix: &Path) -> PathBuf {
    let number = LINKED_PYTHON.version_number();
    let minor = number.rsplit_once('.').map_or(number, |(minor, _)| minor);
    prefix.join("lib").join(format!("python{minor}")).join("site-packages")
}

fn metadata(prefix: &Path) -> PathBuf {
    let folder = format!("dmprl-{}.dist-info", env!("CARGO_PKG_VERSION"));
    site_packages(prefix).join(folder).join("METADATA")
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn program_is_installed_beside_the_package_of_its_version() {
        let directory = tempfile::tempdir().unwrap();
        let (prefix, bin) = (directory.path(), directory.path().join("bin"));
        let program = bin.join("dmprl");
        fs::create_dir(&bin).unwrap();
        fs::write(bin.join("python"), "").unwrap();
        assert_eq!(installed(&program), None, "a program beside any Python is not installed");
        let metadata = metadata(prefix);
        fs::create_dir_all(metadata.parent().unwrap()).unwrap();
        fs::write(&metadata, "").unwrap();
        assert_eq!(installed(&program), Some(PythonEnvironment::of(prefix.to_owned())));
        assert_eq!(installed(&prefix.join("libexec/dmprl")), None);
    }
}
