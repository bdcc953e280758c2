//! The list of packages that a user added to the environment. It is a file of pip's requirements
//! beside `.venv`, so it survives when `.venv` is recreated.

use std::{fs, io, path::PathBuf};

use anyhow::{Context, Result};

use super::requirement::Requirement;

const HEADER: &str = "\
# Packages added by `dmprl env add`, in pip's syntax. dmprl installs them whenever it creates this
# environment or this list changes.
";

/// The list and its file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct UserPackages {
    file: PathBuf,
    /// The packages, in the order in which they were added.
    pub list: Vec<Requirement>,
}

impl UserPackages {
    /// Reads the list; it is empty if the file does not exist.
    ///
    /// # Errors
    /// The file cannot be read.
    pub(super) fn read(file: PathBuf) -> Result<Self> {
        let text = match fs::read_to_string(&file) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => String::new(),
            text => text.with_context(|| format!("cannot read {}", file.display()))?,
        };
        let lines = text.lines().map(str::trim);
        let list = lines.filter(|line| !line.is_empty() && !line.starts_with('#'));
        Ok(Self { list: list.map(Requirement::of_line).collect(), file })
    }

    /// Returns the list with `added`, which replace entries for the same packages.
    pub(super) fn with(&self, added: &[Requirement]) -> Self {
        let mut changed = self.clone();
        for requirement in added {
            changed.list.retain(|old| !requirement.replaces(old));
            changed.list.push(requirement.clone());
        }
        changed
    }

    /// Returns the list without the packages that `removed` name. A name removes all its entries.
    pub(super) fn without(&self, removed: &[Requirement]) -> Self {
        let mut changed = self.clone();
        changed.list.retain(|entry| {
            !removed.iter().any(|it| {
                it.replaces(entry)
                    || (it.name().is_some() && it.extras().is_empty() && it.name() == entry.name())
            })
        });
        changed
    }

    /// Returns one requirement a line.
    pub(super) fn text(&self) -> String {
        self.list.iter().map(|requirement| format!("{}\n", requirement.line())).collect()
    }

    /// Replaces the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(super) fn write(&self) -> Result<()> {
        dmprl_run::replace_file(&self.file, format!("{HEADER}{}", self.text()).as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn requirements(lines: &[&str]) -> Vec<Requirement> {
        lines.iter().map(|line| Requirement::of_line(line)).collect()
    }

    #[test]
    fn list_is_written_read_and_changed() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("packages.txt");
        let empty = UserPackages::read(file.clone()).unwrap();
        assert_eq!(empty.text(), "");
        let added = requirements(&["torch", "dmprl[video]", "-e /home/me/arm"]);
        let list = empty.with(&added).with(&requirements(&["Torch>=2", "dmprl[search]"]));
        list.write().unwrap();
        let read = UserPackages::read(file).unwrap();
        assert_eq!(read, list);
        assert_eq!(read.text(), "dmprl[video]\n-e /home/me/arm\nTorch>=2\ndmprl[search]\n");
        let rest = read.without(&requirements(&["torch", "/home/me/arm", "dmprl[search]"]));
        assert_eq!(rest.text(), "dmprl[video]\n");
    }
}
