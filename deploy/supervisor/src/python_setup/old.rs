//! Environments that were replaced and kept, because a user had installed packages into them.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail};

use super::{
    installed::{InstalledPackage, installed_by_hand},
    paths::VENV,
    requirement::{EDITABLE, Requirement},
    stamp,
};

/// An environment that was renamed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OldEnvironment {
    /// The folder, beside `.venv`.
    pub folder: PathBuf,
    /// Commands that add the user's packages to the present environment.
    pub commands: Vec<String>,
}

impl OldEnvironment {
    /// Returns what a user should know about it.
    pub(super) fn notice(&self) -> String {
        let mut text = format!("the old .venv is kept as {}", self.folder.display());
        if !self.commands.is_empty() {
            text += "; it has packages that the new one lacks. To install them again:";
            self.commands.iter().for_each(|command| text += &format!("\n  {command}"));
        }
        text + "\nDelete the folder when you do not need it any more."
    }
}

/// Makes way for a new `.venv`. Renames the old one if it has packages that its user installed or
/// if dmprl did not create it; otherwise deletes it.
///
/// - `known`: packages that the new environment will have.
///
/// # Errors
/// It is not a virtual environment, or the file system refuses.
pub(super) fn make_way(venv: &Path, known: &[Requirement]) -> Result<Option<OldEnvironment>> {
    let is_marked = stamp::is_marked(venv);
    let is_environment = venv.join("pyvenv.cfg").exists() || is_marked;
    let is_empty = || fs::read_dir(venv).is_ok_and(|mut entries| entries.next().is_none());
    if !is_environment && !is_empty() {
        bail!(
            "{} is not a virtual environment; move it away, as dmprl creates its own there",
            venv.display()
        );
    }
    let by_hand = installed_by_hand(venv, known);
    if by_hand.is_empty() && (is_marked || !is_environment) {
        // Remove the stamp first: an interrupted removal must not leave an environment that looks
        // complete.
        stamp::remove(venv)?;
        fs::remove_dir_all(venv).with_context(|| format!("cannot remove {}", venv.display()))?;
        return Ok(None);
    }
    let folder = free_name(venv);
    fs::rename(venv, &folder)
        .with_context(|| format!("cannot rename {} to {}", venv.display(), folder.display()))?;
    Ok(Some(OldEnvironment { folder, commands: commands(&by_hand) }))
}

/// Lists the environments that were renamed, oldest first.
pub(super) fn old_environments(root: &Path, known: &[Requirement]) -> Vec<OldEnvironment> {
    let entries = fs::read_dir(root).into_iter().flatten().flatten();
    let is_old = |name: &str| name.strip_prefix(VENV).is_some_and(|it| it.starts_with(".old-"));
    let mut folders: Vec<PathBuf> = entries
        .filter(|entry| entry.file_name().to_str().is_some_and(is_old))
        .map(|entry| entry.path())
        .collect();
    folders.sort();
    let old = |folder: PathBuf| OldEnvironment {
        commands: commands(&installed_by_hand(&folder, known)),
        folder,
    };
    folders.into_iter().map(old).collect()
}

/// Returns the commands that add these packages to the environment: one for all that are named,
/// one for folders that are used in place.
pub(super) fn commands(packages: &[InstalledPackage]) -> Vec<String> {
    let requirements = packages.iter().map(|package| package.requirement.as_str());
    let (editable, named): (Vec<&str>, Vec<&str>) =
        requirements.partition(|requirement| requirement.starts_with(EDITABLE));
    let command = |flag: &str, packages: Vec<String>| {
        (!packages.is_empty()).then(|| format!("dmprl env add {flag}{}", packages.join(" ")))
    };
    let paths = editable.iter().map(|it| quoted(it.trim_start_matches(EDITABLE))).collect();
    [command("", named.into_iter().map(quoted).collect()), command("--editable ", paths)]
        .into_iter()
        .flatten()
        .collect()
}

/// Quotes a word for a shell, if necessary.
fn quoted(word: &str) -> String {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_./=:+".contains(&byte);
    if word.bytes().all(is_plain) { word.to_owned() } else { format!("'{word}'") }
}

fn free_name(venv: &Path) -> PathBuf {
    let stem = format!("{VENV}.old-{}", dmprl_run::compact_now());
    let names = std::iter::once(stem.clone()).chain((2..).map(|count| format!("{stem}-{count}")));
    let mut paths = names.map(|name| venv.with_file_name(name));
    // The second environment within a second gets a number.
    paths.find(|path| fs::symlink_metadata(path).is_err()).unwrap_or_else(|| venv.join(stem))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directory_without_a_virtual_environment_is_not_touched() {
        let directory = tempfile::tempdir().unwrap();
        fs::write(directory.path().join("thesis.tex"), "").unwrap();
        let error = make_way(directory.path(), &[]).unwrap_err().to_string();
        assert!(error.contains("is not a virtual environment"), "{error}");
        assert!(directory.path().join("thesis.tex").exists());
    }

    #[test]
    fn environment_that_dmprl_did_not_create_is_kept() {
        let root = tempfile::tempdir().unwrap();
        let venv = root.path().join(VENV);
        for _ in 0..2 {
            fs::create_dir(&venv).unwrap();
            fs::write(venv.join("pyvenv.cfg"), "mine").unwrap();
            let old = make_way(&venv, &[]).unwrap().unwrap();
            assert_eq!(fs::read_to_string(old.folder.join("pyvenv.cfg")).unwrap(), "mine");
            assert!(!venv.exists());
        }
        assert_eq!(old_environments(root.path(), &[]).len(), 2);
    }

    #[test]
    fn environment_with_only_our_packages_is_deleted() {
        let root = tempfile::tempdir().unwrap();
        let venv = root.path().join(VENV);
        stamp::begin(&venv).unwrap();
        let package = venv.join("lib/python3.11/site-packages/numpy-2.5.0.dist-info");
        fs::create_dir_all(&package).unwrap();
        fs::write(package.join("REQUESTED"), "").unwrap();
        assert_eq!(make_way(&venv, &[Requirement::of_line("numpy==2.4.6")]).unwrap(), None);
        assert!(!venv.exists());
    }
}
