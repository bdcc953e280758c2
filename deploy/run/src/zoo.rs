//! Trained policies that come with the Python package, named `zoo:NAME`.
//!
//! The folder `zoo/NAME` of the package has the files of a run directory that a policy needs, and
//! nothing else. A command that opens `zoo:NAME` copies it to `runs/zoo-NAME` first, because it
//! writes logs, videos or exports there.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;

use crate::directory::{FOLDERS, RunDirectory};
use crate::failure::wrong_use;

/// Begins the name of a policy of the zoo, in place of a run directory's path.
const PREFIX: &str = "zoo:";
/// Marks a copy, which `resume` must not start again from the beginning.
const MARK: &str = "copied-from.txt";
/// Files of a policy, beside its folder `policies`.
const FILES: [&str; 4] = ["config.toml", "spec.json", "evaluations.jsonl", "manifest.json"];

/// The policies of one installation.
#[derive(Debug, Clone)]
pub struct Zoo {
    folder: PathBuf,
}

impl Zoo {
    /// Returns the policies in a Python package's folder `dmprl`.
    #[must_use]
    pub fn of_package(package: &Path) -> Self {
        Self { folder: package.join("zoo") }
    }

    /// Returns the name in `zoo:NAME`, or `None` if this is the path of a run directory.
    #[must_use]
    pub fn name(path: &Path) -> Option<&str> {
        path.to_str()?.strip_prefix(PREFIX)
    }

    /// Returns whether a run directory is a copy of one of these policies.
    #[must_use]
    pub fn is_copy(run: &RunDirectory) -> bool {
        run.path().join(MARK).is_file()
    }

    /// Lists the names.
    ///
    /// # Errors
    /// The folder cannot be read.
    pub fn names(&self) -> anyhow::Result<Vec<String>> {
        let unread = || format!("cannot read {}", self.folder.display());
        let mut names = Vec::new();
        for entry in self.folder.read_dir().with_context(unread)? {
            let path = entry.with_context(unread)?.path();
            if path.join("manifest.json").is_file()
                && let Some(name) = path.file_name().and_then(|name| name.to_str())
            {
                names.push(name.to_owned());
            }
        }
        names.sort();
        Ok(names)
    }

    /// Opens the copy of a policy in the folder `runs`, and makes it first if there is none.
    ///
    /// # Errors
    /// Wrong use: the name is unknown, or another run has the place of the copy. Also an I/O error.
    pub fn open(&self, name: &str, runs: &Path) -> anyhow::Result<RunDirectory> {
        let names = self.names()?;
        if !names.iter().any(|known| known == name) {
            return Err(wrong_use(format!(
                "there is no policy {PREFIX}{name}; expected one of {}",
                names.join(", ")
            )));
        }
        let original = RunDirectory::open(&self.folder.join(name))?;
        let place = runs.join(format!("zoo-{name}"));
        if !place.exists() {
            copy(&original, name, runs, &place)
                .with_context(|| format!("cannot copy {PREFIX}{name} to {}", place.display()))?;
        }
        let copied = RunDirectory::open(&place)?;
        if copied.manifest()? == original.manifest()? {
            return Ok(copied);
        }
        Err(wrong_use(format!(
            "{} is another run, or {PREFIX}{name} of another version of dmprl; rename or remove it",
            place.display()
        )))
    }
}

/// Copies a policy's files, into place at once.
fn copy(from: &RunDirectory, name: &str, runs: &Path, place: &Path) -> anyhow::Result<()> {
    let from = from.path();
    fs::create_dir_all(runs)?;
    let folder = tempfile::Builder::new().prefix(".zoo-").tempdir_in(runs)?;
    for name in FOLDERS {
        fs::create_dir(folder.path().join(name))?;
    }
    fs::File::create_new(folder.path().join("metrics.jsonl"))?;
    fs::write(folder.path().join(MARK), format!("{PREFIX}{name}\n"))?;
    for file in FILES {
        fs::copy(from.join(file), folder.path().join(file)).context(file)?;
    }
    let policies = from.join("policies");
    for entry in policies.read_dir()? {
        let name = entry?.file_name();
        fs::copy(policies.join(&name), folder.path().join("policies").join(&name))?;
    }
    RunDirectory::open(folder.path())?.point_best()?;
    // As a run directory of `train`, it is readable for others if the umask allows it.
    let mode = fs::metadata(folder.path().join("policies"))?.permissions();
    fs::set_permissions(folder.path(), mode)?;
    match fs::rename(folder.path(), place) {
        Ok(()) => {
            // It has another name now, so nothing is left to remove.
            let _ = folder.keep();
            Ok(())
        }
        // Another command was faster.
        Err(_) if place.exists() => Ok(()),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests;
