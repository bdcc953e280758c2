//! Creates or updates `.venv` until it has what it must have.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result};
use dmprl_actors::python_env::LINKED_PYTHON;

use super::{
    command::Setup,
    declared::Declared,
    environment::PythonEnvironment,
    home::Home,
    lock::locked,
    locks, old,
    paths::{LOCK, PACKAGE, USER_PACKAGES, VENV},
    stamp::{self, Fit, Inputs, Stamp},
    together,
    user_packages::UserPackages,
};

/// Reasons for which an environment is changed.
const REQUIREMENTS_CHANGED: &str = "pyproject.toml or locks/base.txt of envs_py has changed";
const LIST_CHANGED: &str = "the list of added packages has changed";

/// Ensures that `.venv` in `project_root` has `envs_py` and its requirements.
///
/// - `project_root`: the directory with `envs_py`, where the program was built.
/// - `progress`: called with a line at least once a second during the work, and not at all if there
///   is nothing to do.
///
/// # Errors
/// The last lines of the command that failed, and a remedy: which Debian package is missing, that
/// the package index is unreachable, or which packages do not go with each other. A `.venv` that is
/// not a virtual environment is kept.
pub fn ensure(project_root: &Path, progress: &dyn Fn(&str)) -> Result<PythonEnvironment> {
    let Wanted { root, stamp, .. } = wanted(project_root)?;
    let environment = PythonEnvironment::of(root.join(VENV));
    // Reading the stamp needs no lock: it is written last and removed first.
    if stamp.compare(&environment.venv) == Fit::Ready {
        return Ok(environment);
    }
    let lock = locked(&root.join(LOCK), progress)?;
    // Read again, because another process may have changed the list of added packages.
    let Wanted { root, stamp, user } = wanted(&root)?;
    let home = Home::Clone(root);
    let setup = Setup { environment: &environment, lock: &lock, progress };
    let fit = stamp.compare(&environment.venv);
    match &fit {
        Fit::Ready => return Ok(environment), // a concurrent start was faster
        Fit::OtherUserPackages => progress(&format!("python environment: {LIST_CHANGED}")),
        Fit::OtherPackages => {
            progress(&format!("python environment: {REQUIREMENTS_CHANGED}, reinstalling"));
            stamp::remove(&environment.venv)?;
        }
        Fit::Absent => setup.create()?,
        Fit::Unusable(why) => {
            progress(&format!("python environment: recreating .venv: {why}"));
            let known = together::known(&home, &user)?;
            if let Some(old) = old::make_way(&environment.venv, &known)? {
                tracing::warn!("{}", old.notice());
            }
            setup.create()?;
        }
    }
    if fit != Fit::OtherUserPackages {
        setup.install(&home.package_path())?;
        // The environment is complete without the added packages.
        stamp.without_user_packages().write(&environment.venv)?;
    }
    together::install_user_packages(&home, &setup, &user).with_context(|| {
        format!("cannot install the list {USER_PACKAGES}; shorten it with `dmprl env remove`")
    })?;
    stamp.write(&environment.venv)?;
    progress("python environment: ready");
    Ok(environment)
}

/// Ensures that the environment of `home`, which exists, has the requirements of an optional part.
pub(super) fn ensure_installed(
    home: &Home,
    extra: &str,
    progress: &dyn Fn(&str),
) -> Result<PythonEnvironment> {
    let environment = PythonEnvironment::of(home.venv());
    let declared = Declared::read(&home.requirements())?;
    let requirements = declared.extra(extra)?;
    let locked_packages = match home {
        Home::Clone(_) => locks::of_extra(&home.package_path(), extra),
        Home::Installed(_) => None,
    };
    let mut text = requirements.join("\n");
    if let Some(path) = &locked_packages {
        let packages = fs::read_to_string(path);
        text += &packages.with_context(|| format!("cannot read {}", path.display()))?;
    }
    let stamp = together::extra_stamp(&environment.venv, extra);
    let is_ready = || match home {
        Home::Clone(_) => fs::read_to_string(&stamp).is_ok_and(|found| found == text),
        Home::Installed(host) => host.has_extra(extra),
    };
    if is_ready() {
        return Ok(environment);
    }
    let lock = locked(&home.lock(), progress)?;
    // A concurrent start may have been faster.
    if !is_ready() {
        let setup = Setup { environment: &environment, lock: &lock, progress };
        let wanted = requirements.join(" ");
        match &locked_packages {
            Some(path) => setup.install_locked(&format!("installing {wanted}"), path),
            None => setup.install_together(&requirements),
        }
        .with_context(|| format!("cannot install {wanted}"))?;
        fs::write(&stamp, text).with_context(|| format!("cannot write {}", stamp.display()))?;
        // The locked versions may not go with a user's packages.
        together::install_user_packages(home, &setup, &UserPackages::read(home.user_packages())?)
            .with_context(|| format!("the packages that you added do not go with {wanted}"))?;
        progress("python environment: ready");
    }
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
pub(super) fn state(project_root: &Path) -> State {
    let Wanted { root, stamp, .. } = match wanted(project_root) {
        Ok(found) => found,
        Err(error) => return State::Stale(format!("{error:#}")),
    };
    match stamp.compare(&root.join(VENV)) {
        Fit::Ready => State::Ready,
        Fit::Absent => State::Missing,
        Fit::OtherUserPackages => State::Stale(LIST_CHANGED.to_owned()),
        Fit::OtherPackages => State::Stale(REQUIREMENTS_CHANGED.to_owned()),
        Fit::Unusable(why) => State::Stale(why),
    }
}

/// What `.venv` must be.
struct Wanted {
    /// The resolved project directory.
    root: PathBuf,
    stamp: Stamp,
    user: UserPackages,
}

fn wanted(project_root: &Path) -> Result<Wanted> {
    let root = fs::canonicalize(project_root)
        .with_context(|| format!("project directory {}", project_root.display()))?;
    let package = root.join(PACKAGE);
    let read = |path: &Path| {
        fs::read_to_string(path)
            .with_context(|| format!("{} (is this the project's directory?)", path.display()))
    };
    let user = UserPackages::read(root.join(USER_PACKAGES))?;
    let inputs = Inputs {
        root: &root,
        manifest: &read(&package.join("pyproject.toml"))?,
        lock: &read(&locks::base(&package))?,
        user_packages: &user.text(),
    };
    let stamp = Stamp::new(&LINKED_PYTHON, &inputs);
    Ok(Wanted { root, stamp, user })
}

/// Records that the added packages are installed. The caller holds the lock.
pub(super) fn stamp_user_packages(home: &Home) -> Result<()> {
    let Home::Clone(root) = home else { return Ok(()) };
    let Wanted { root, stamp, .. } = wanted(root)?;
    let venv = root.join(VENV);
    // If the requirements have changed meanwhile, the next start installs everything.
    if stamp.compare(&venv) == Fit::OtherUserPackages { stamp.write(&venv) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directory_without_the_project_is_rejected() {
        let directory = tempfile::tempdir().unwrap();
        let error = format!("{:#}", ensure(directory.path(), &|_| ()).unwrap_err());
        assert!(error.contains("is this the project's directory?"), "{error}");
    }
}
