//! The requirements that the Python package declares: its own and those of its optional parts.

use std::{collections::BTreeMap, ffi::OsStr, fs, path::Path};

use anyhow::{Context, Result};
use toml::{Table, Value};

use super::requirement::{OURS, Requirement, normalised};

/// The optional part with the simulation, which every command with environments needs.
pub(super) const SIMULATION: &str = "sim";

/// Requirements of the package, in pip's syntax.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Declared {
    /// What the package itself needs.
    base: Vec<String>,
    /// What each optional part needs.
    extras: BTreeMap<String, Vec<String>>,
}

impl Declared {
    /// Reads `pyproject.toml` or an installed package's METADATA.
    ///
    /// # Errors
    /// The file cannot be read.
    pub(super) fn read(file: &Path) -> Result<Self> {
        let text =
            fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
        if file.extension() == Some(OsStr::new("toml")) {
            let project = text.parse().with_context(|| format!("{}", file.display()))?;
            return Ok(Self::of_project(&project));
        }
        Ok(Self::of_metadata(&text))
    }

    /// Returns the requirements of an environment in which simulations run.
    pub(super) fn base(&self) -> Vec<String> {
        let simulation = self.extras.get(SIMULATION).cloned().unwrap_or_default();
        self.base.iter().cloned().chain(simulation).collect()
    }

    /// Returns the requirements of an optional part, including those of parts that it consists of,
    /// such as `dmprl[video]`.
    ///
    /// # Errors
    /// There is no such part; the error lists all.
    pub(super) fn extra(&self, extra: &str) -> Result<Vec<String>> {
        let found = self.extras.get(extra).with_context(|| {
            let known: Vec<&str> = self.extras.keys().map(String::as_str).collect();
            format!("dmprl has no optional part `{extra}`, only: {}", known.join(", "))
        })?;
        let mut requirements = Vec::new();
        for line in found {
            let requirement = Requirement::of_line(line);
            match requirement.name().as_deref() {
                Some(OURS) => {
                    for part in requirement.extras().iter().filter(|part| *part != extra) {
                        requirements.extend(self.extra(part)?);
                    }
                }
                _ => requirements.push(line.clone()),
            }
        }
        Ok(requirements)
    }

    fn of_project(project: &Table) -> Self {
        let strings = |list: &Value| -> Vec<String> {
            let list = list.as_array().map_or(&[][..], Vec::as_slice);
            list.iter().filter_map(|text| text.as_str().map(str::to_owned)).collect()
        };
        let of = |key| project.get("project").and_then(|project| project.get(key));
        let extras = of("optional-dependencies").and_then(Value::as_table);
        Self {
            base: of("dependencies").map(strings).unwrap_or_default(),
            extras: extras
                .into_iter()
                .flatten()
                .map(|(name, list)| (normalised(name), strings(list)))
                .collect(),
        }
    }

    /// Reads lines such as `Requires-Dist: av>=18,<19 ; extra == 'video'`.
    fn of_metadata(metadata: &str) -> Self {
        let mut declared = Self::default();
        let headers = metadata.lines().take_while(|line| !line.is_empty());
        for required in headers.filter_map(|line| line.strip_prefix("Requires-Dist:")) {
            let (requirement, marker) = required.split_once(';').unwrap_or((required, ""));
            let extra = marker.trim().strip_prefix("extra ==").map(str::trim);
            match extra {
                Some(extra) => {
                    let extra = normalised(extra.trim_matches(['\'', '"']));
                    declared.extras.entry(extra).or_default().push(requirement.trim().to_owned());
                }
                None => declared.base.push(required.trim().to_owned()),
            }
        }
        declared
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requirements_are_read_from_both_kinds_of_files() {
        let metadata = "Name: dmprl\nRequires-Dist: numpy>=2\n\
                        Requires-Dist: av>=18,<19 ; extra == 'video'\n\
                        Requires-Dist: pillow>=12 ; extra == \"video\"\n\
                        Requires-Dist: optuna>=5 ; extra == 'search'\n\
                        Requires-Dist: dmprl[video,sim] ; extra == 'all'\n\
                        Requires-Dist: mujoco>=4 ; extra == 'sim'\n\n\
                        Requires-Dist: prose ; extra == 'video'\n";
        let project = "[project]\ndependencies = ['numpy>=2']\n\
                       [project.optional-dependencies]\nvideo = ['av>=18,<19', 'pillow>=12']\n\
                       search = ['optuna>=5']\nsim = ['mujoco>=4']\n\
                       all = ['dmprl[video,sim]']\n";
        let declared = Declared::of_metadata(metadata);
        assert_eq!(declared, Declared::of_project(&project.parse().unwrap()));
        assert_eq!(declared.base(), ["numpy>=2", "mujoco>=4"]);
        assert_eq!(declared.extra("all").unwrap(), ["av>=18,<19", "pillow>=12", "mujoco>=4"]);
        assert_eq!(declared.extra("video").unwrap(), ["av>=18,<19", "pillow>=12"]);
        let error = declared.extra("sound").unwrap_err().to_string();
        assert!(
            error.ends_with("no optional part `sound`, only: all, search, sim, video"),
            "{error}"
        );
    }
}
