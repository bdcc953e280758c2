//! Trained policies that come with the Python package, named `zoo:NAME`.
//!
//! The folder `zoo/NAME` of the package has the files of a run directory that a policy needs, and
//! nothing else. A command that opens `zoo:NAME` copies it to `runs/zoo-NAME` first, because it
//! writes logs, videos or exports there.

use std::path::{Path, PathBuf};

use anyhow::Context;

use crate::directory::RunDirectory;
use crate::failure::wrong_use;

/// Begins the name of a policy of the zoo, in place of a run directory's path.
const PREFIX: &str = "zoo:";

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
            original
                .copy_policy(&format!("{PREFIX}{name}"), &place)
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

#[cfg(test)]
mod tests;
