//! Optional parts of the Python package, which are installed when a command first needs them.

use std::{fs, path::Path};

use anyhow::{Context, Result};
use toml::Table;

use super::{LOCK, PACKAGE, PythonEnvironment, command::Setup, ensure, locked, wanted};

/// Makes sure that `.venv` holds the package, as [`ensure`] does, and what its optional part
/// `extra` requires: `[project.optional-dependencies]` of `envs_py/pyproject.toml`.
///
/// A file in `.venv` says which requirements were met, so that later starts neither run pip nor
/// need a network; it goes with a `.venv` that is made anew.
///
/// # Errors
/// As [`ensure`]; the package has no such part.
pub fn ensure_extra(
    project_root: &Path,
    extra: &str,
    progress: &dyn Fn(&str),
) -> Result<PythonEnvironment> {
    let environment = ensure(project_root, progress)?;
    let (root, _) = wanted(project_root)?;
    let package = root.join(PACKAGE);
    let requirements = requirements(&package.join("pyproject.toml"), extra)?;
    let (stamp, text) =
        (environment.venv.join(format!("dmprl-extra-{extra}.txt")), requirements.join("\n"));
    let is_ready = || fs::read_to_string(&stamp).is_ok_and(|found| found == text);
    if is_ready() {
        return Ok(environment);
    }
    let lock = locked(&root.join(LOCK), progress)?;
    // Another start may have been faster.
    if !is_ready() {
        let setup = Setup { environment: &environment, package: &package, lock: &lock, progress };
        setup
            .install_extra(&requirements)
            .with_context(|| format!("cannot install {}", requirements.join(" ")))?;
        fs::write(&stamp, text).with_context(|| format!("cannot write {}", stamp.display()))?;
        progress("python environment: ready");
    }
    Ok(environment)
}

fn requirements(manifest: &Path, extra: &str) -> Result<Vec<String>> {
    let text = fs::read_to_string(manifest)
        .with_context(|| format!("cannot read {}", manifest.display()))?;
    let table: Table = text.parse().with_context(|| format!("{}", manifest.display()))?;
    let extras = table.get("project").and_then(|project| project.get("optional-dependencies"));
    let listed = extras.and_then(|extras| extras.get(extra)).and_then(|listed| listed.as_array());
    let texts = listed.map(|listed| {
        listed.iter().filter_map(|text| text.as_str().map(str::to_owned)).collect::<Vec<_>>()
    });
    texts.with_context(|| format!("{} has no optional part `{extra}`", manifest.display()))
}
