//! Installs optional parts of the Python package when a command first needs them.

use std::{ffi::OsStr, fs, path::Path};

use anyhow::{Context, Result};
use toml::Table;

use super::{Home, PythonEnvironment, command::Setup, locked};

/// Ensures that the environment of `home` has the package, as [`Home::ensure`] does, and the
/// requirements of its optional part `extra`.
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
    let requirements = requirements(&home.requirements(), extra)?;
    let (stamp, text) =
        (environment.venv.join(format!("dmprl-extra-{extra}.txt")), requirements.join("\n"));
    let is_ready = || fs::read_to_string(&stamp).is_ok_and(|found| found == text);
    if is_ready() {
        return Ok(environment);
    }
    let lock = locked(&home.lock(), progress)?;
    // A concurrent start may have been faster.
    if !is_ready() {
        let setup = Setup { environment: &environment, lock: &lock, progress };
        setup
            .install_extra(&requirements)
            .with_context(|| format!("cannot install {}", requirements.join(" ")))?;
        fs::write(&stamp, text).with_context(|| format!("cannot write {}", stamp.display()))?;
        progress("python environment: ready");
    }
    Ok(environment)
}

/// Reads the requirements of a part from `pyproject.toml` or an installed package's METADATA.
fn requirements(file: &Path, extra: &str) -> Result<Vec<String>> {
    let text =
        fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
    let listed = if file.extension() == Some(OsStr::new("toml")) {
        of_project(&text.parse().with_context(|| format!("{}", file.display()))?, extra)
    } else {
        of_metadata(&text, extra)
    };
    listed.with_context(|| format!("{} has no optional part `{extra}`", file.display()))
}

fn of_project(project: &Table, extra: &str) -> Option<Vec<String>> {
    let extras = project.get("project")?.get("optional-dependencies")?;
    let listed = extras.get(extra)?.as_array()?;
    Some(listed.iter().filter_map(|text| text.as_str().map(str::to_owned)).collect())
}

/// Reads lines such as `Requires-Dist: av>=18,<19 ; extra == 'video'`.
fn of_metadata(metadata: &str, extra: &str) -> Option<Vec<String>> {
    let headers = metadata.lines().take_while(|line| !line.is_empty());
    let required = headers.filter_map(|line| line.strip_prefix("Requires-Dist:"));
    let of_extra: Vec<String> = required
        .filter_map(|line| line.split_once(';'))
        .filter(|(_, marker)| {
            let wanted = marker.trim().strip_prefix("extra ==").map(str::trim);
            wanted.map(|name| name.trim_matches(['\'', '"'])) == Some(extra)
        })
        .map(|(requirement, _)| requirement.trim().to_owned())
        .collect();
    (!of_extra.is_empty()).then_some(of_extra)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requirements_are_read_from_both_kinds_of_files() {
        let metadata = "Name: dmprl\nRequires-Dist: numpy>=2\n\
                        Requires-Dist: av>=18,<19 ; extra == 'video'\n\
                        Requires-Dist: pillow>=12 ; extra == \"video\"\n\
                        Requires-Dist: optuna>=5 ; extra == 'search'\n\n\
                        Requires-Dist: prose ; extra == 'video'\n";
        let project = "[project.optional-dependencies]\nvideo = ['av>=18,<19', 'pillow>=12']\n";
        let expected = Some(vec!["av>=18,<19".to_owned(), "pillow>=12".to_owned()]);
        assert_eq!(of_metadata(metadata, "video"), expected);
        assert_eq!(of_project(&project.parse().unwrap(), "video"), expected);
        assert_eq!(of_metadata(metadata, "sound"), None);
        assert_eq!(of_project(&project.parse().unwrap(), "sound"), None);
    }
}
