//! Installs optional parts of the Python package when a command first needs them.

use std::fs;

use anyhow::{Context, Result};

use super::{
    command::Setup,
    declared::Declared,
    environment::PythonEnvironment,
    home::Home,
    lock::locked,
    locks,
    together::{extra_stamp, install_user_packages},
    user_packages::UserPackages,
};

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
    let environment = home.ensure(progress)?;
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
    let stamp = extra_stamp(&environment.venv, extra);
    let is_ready = || fs::read_to_string(&stamp).is_ok_and(|found| found == text);
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
            None => setup.install_together(requirements),
        }
        .with_context(|| format!("cannot install {wanted}"))?;
        fs::write(&stamp, text).with_context(|| format!("cannot write {}", stamp.display()))?;
        // The locked versions may not go with a user's packages.
        install_user_packages(home, &setup, &UserPackages::read(home.user_packages())?)
            .with_context(|| format!("the packages that you added do not go with {wanted}"))?;
        progress("python environment: ready");
    }
    Ok(environment)
}
