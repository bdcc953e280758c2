//! Stage 2 of 8: creates `.venv` and installs `envs_py` into it. Every command that needs
//! environments calls it.
//!
//! The virtual environment is created with the interpreter against which the program is linked: a
//! package built for another Python may crash this one. A stamp, which is written last, records the
//! inputs of the environment. If it matches, [`ensure`] only reads two small files. A lock file
//! serialises concurrent starts. If pip installed the program, it is in an environment already (see
//! [`Home`]).

mod advice;
mod command;
mod environment;
mod extra;
mod home;
mod packages;
mod stamp;

use std::{
    fs::{self, File, TryLockError},
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, Result, bail};
use dmprl_actors::python_env::LINKED_PYTHON;

use self::{
    command::Setup,
    stamp::{Fit, Stamp},
};
pub use self::{
    environment::PythonEnvironment, extra::ensure_extra, home::Home, packages::packages,
};

/// Name of the virtual environment in the project's root.
const VENV: &str = ".venv";
/// Lock file beside `.venv`: it must survive when `.venv` is recreated.
const LOCK: &str = ".venv.lock";
/// Maximum wait for the lock, longer than an installation over a slow connection takes.
const LOCK_WAIT_MAX: Duration = Duration::from_secs(30 * 60);
/// Interval between attempts to take the lock, each with a progress line.
const LOCK_INTERVAL: Duration = Duration::from_millis(500);
/// The Python package, relative to the project's root.
const PACKAGE: &str = "envs_py";

/// Ensures that `.venv` in `project_root` has `envs_py` and its requirements.
///
/// - `project_root`: the directory with `envs_py`, where the program was built.
/// - `progress`: called with a line at least once a second during the work, and not at all if there
///   is nothing to do.
///
/// # Errors
/// The last lines of the command that failed, and a remedy: which Debian package is missing, or
/// that the package index is unreachable. A `.venv` that is not a virtual environment is kept.
pub fn ensure(project_root: &Path, progress: &dyn Fn(&str)) -> Result<PythonEnvironment> {
    let (root, wanted) = wanted(project_root)?;
    let package = root.join(PACKAGE);
    let environment = PythonEnvironment::of(root.join(VENV));
    // Reading the stamp needs no lock: it is written last and removed first.
    if wanted.compare(&environment.venv) == Fit::Ready {
        return Ok(environment);
    }
    let lock = locked(&root.join(LOCK), progress)?;
    let setup = Setup { environment: &environment, lock: &lock, progress };
    match wanted.compare(&environment.venv) {
        Fit::Ready => return Ok(environment), // a concurrent start was faster
        Fit::OtherPackages => {
            progress("python environment: envs_py/pyproject.toml has changed, reinstalling");
            stamp::remove(&environment.venv)?;
        }
        Fit::Absent => setup.create()?,
        Fit::Unusable(why) => {
            progress(&format!("python environment: recreating .venv: {why}"));
            remove(&environment.venv)?;
            setup.create()?;
        }
    }
    setup.install(&package)?;
    wanted.write(&environment.venv)?;
    progress("python environment: ready");
    Ok(environment)
}

/// State of `.venv`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum State {
    /// [`ensure`] uses it as it is.
    Ready,
    /// [`ensure`] creates it.
    Missing,
    /// [`ensure`] changes or recreates it, for this reason.
    Stale(String),
}

/// Inspects `.venv` in `project_root`, without changes and without waiting.
#[must_use]
pub fn state(project_root: &Path) -> State {
    let (root, wanted) = match wanted(project_root) {
        Ok(found) => found,
        Err(error) => return State::Stale(format!("{error:#}")),
    };
    match wanted.compare(&root.join(VENV)) {
        Fit::Ready => State::Ready,
        Fit::Absent => State::Missing,
        Fit::OtherPackages => State::Stale("envs_py/pyproject.toml has changed".to_owned()),
        Fit::Unusable(why) => State::Stale(why),
    }
}

/// Returns the resolved project directory and the stamp that its `.venv` must have.
fn wanted(project_root: &Path) -> Result<(PathBuf, Stamp)> {
    let root = fs::canonicalize(project_root)
        .with_context(|| format!("project directory {}", project_root.display()))?;
    let manifest = root.join(PACKAGE).join("pyproject.toml");
    let manifest = fs::read_to_string(&manifest)
        .with_context(|| format!("{} (is this the project's directory?)", manifest.display()))?;
    let wanted = Stamp::new(&LINKED_PYTHON, &root, &manifest);
    Ok((root, wanted))
}

/// Waits for a concurrent start that creates the same `.venv`. The system releases the lock with
/// its last holder, so a crash leaves no stale lock.
fn locked(path: &Path, progress: &dyn Fn(&str)) -> Result<File> {
    let lock = File::options()
        .create(true)
        .truncate(false)
        .read(true)
        .write(true)
        .open(path)
        .with_context(|| format!("cannot write {}", path.display()))?;
    let started = Instant::now();
    // `File::lock` has no time limit and reports no progress.
    while started.elapsed() < LOCK_WAIT_MAX {
        match lock.try_lock() {
            Ok(()) => return Ok(lock),
            Err(TryLockError::WouldBlock) => {}
            Err(TryLockError::Error(error)) => {
                return Err(error).with_context(|| format!("cannot lock {}", path.display()));
            }
        }
        let seconds = started.elapsed().as_secs();
        progress(&format!("python environment: waiting for another start ({seconds} s)"));
        thread::sleep(LOCK_INTERVAL);
    }
    bail!(
        "another process has been creating {VENV} for {} minutes; stop it, or its pip, and retry",
        LOCK_WAIT_MAX.as_secs() / 60
    )
}

/// Removes a virtual environment; refuses to remove anything else of that name.
fn remove(venv: &Path) -> Result<()> {
    let is_ours = venv.join("pyvenv.cfg").exists() || venv.join(stamp::MAKING).exists();
    let is_empty = || fs::read_dir(venv).is_ok_and(|mut entries| entries.next().is_none());
    if !is_ours && !is_empty() {
        bail!(
            "{} is not a virtual environment; move it away, as dmprl creates its own there",
            venv.display()
        );
    }
    // Remove the stamp first: an interrupted removal must not leave an environment that looks
    // complete.
    stamp::remove(venv)?;
    fs::remove_dir_all(venv).with_context(|| format!("cannot remove {}", venv.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directory_without_a_virtual_environment_is_not_removed() {
        let directory = tempfile::tempdir().unwrap();
        fs::write(directory.path().join("thesis.tex"), "").unwrap();
        let error = remove(directory.path()).unwrap_err().to_string();
        assert!(error.contains("is not a virtual environment"), "{error}");
        assert!(directory.path().join("thesis.tex").exists());
    }

    #[test]
    fn directory_without_the_project_is_rejected() {
        let directory = tempfile::tempdir().unwrap();
        let error = format!("{:#}", ensure(directory.path(), &|_| ()).unwrap_err());
        assert!(error.contains("is this the project's directory?"), "{error}");
    }
}
