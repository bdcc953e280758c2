//! Makes environments for other libraries, which `.venv` must not contain.

use std::{fs, path::Path};

use anyhow::{Context, Result};

use super::{command::Setup, environment::PythonEnvironment, lock::locked};

/// Copy of the requirements in a complete environment. It is written last.
const MADE_FOR: &str = "dmprl-requirements.txt";

/// Ensures that the environment `venv` has the packages of the file `requirements`. It is made if
/// it is missing, incomplete, or made for other requirements.
///
/// # Errors
/// The file cannot be read, or the installation fails.
pub fn ensure_separate(
    venv: &Path,
    requirements: &Path,
    progress: &dyn Fn(&str),
) -> Result<PythonEnvironment> {
    let wanted = fs::read(requirements)
        .with_context(|| format!("cannot read {}, a file of a clone", requirements.display()))?;
    let lock = locked(&venv.with_extension("lock"), progress)?;
    let environment = PythonEnvironment::of(venv.to_owned());
    let made_for = venv.join(MADE_FOR);
    let is_complete = fs::read(&made_for).is_ok_and(|made_for| made_for == wanted);
    // The interpreter is a link, whose target an upgrade may have removed.
    if is_complete && environment.executable.exists() {
        return Ok(environment);
    }
    if venv.exists() {
        fs::remove_dir_all(venv).with_context(|| format!("cannot remove {}", venv.display()))?;
    }
    let setup = Setup { environment: &environment, lock: &lock, progress };
    setup.create()?;
    setup.install_listed(requirements)?;
    fs::write(&made_for, wanted).with_context(|| format!("cannot write {}", made_for.display()))?;
    Ok(environment)
}
