//! A file in `.venv` that records its inputs: interpreter, project and requirements. It is written
//! last.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result};
use dmprl_actors::python_env::LinkedPython;

/// Must be increased if the content of `.venv` changes for another reason than `pyproject.toml`.
const FORMAT: u32 = 1;
const FILE: &str = "dmprl-stamp.txt";
/// File that is written first. It marks a `.venv` whose creation was interrupted.
pub(super) const MAKING: &str = "dmprl-making.txt";
const MANIFEST_BEGINS: &str = "--- envs_py/pyproject.toml ---";
const LOCK_BEGINS: &str = "--- envs_py/locks/base.txt ---";
const USER_PACKAGES_BEGIN: &str = "--- added packages ---";

/// Everything on which `.venv` depends, as readable text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Stamp {
    python: String,
    packages: String,
    user_packages: String,
}

/// What `.venv` is created from, besides the interpreter.
pub(super) struct Inputs<'a> {
    /// The project's directory; packages and scripts in `.venv` contain absolute paths.
    pub root: &'a Path,
    /// Content of `envs_py/pyproject.toml`.
    pub manifest: &'a str,
    /// Content of the lock.
    pub lock: &'a str,
    /// The packages that a user added, one a line.
    pub user_packages: &'a str,
}

/// Result of comparing `.venv` with the wanted stamp.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Fit {
    /// It can be used.
    Ready,
    /// The right Python, but the package's requirements or their lock have changed.
    OtherPackages,
    /// Complete except for the packages that a user added.
    OtherUserPackages,
    /// It does not exist.
    Absent,
    /// It must be recreated, for this reason.
    Unusable(String),
}

impl Stamp {
    /// A stamp for these inputs.
    pub(super) fn new(linked: &LinkedPython, inputs: &Inputs<'_>) -> Self {
        let python = format!(
            "format {FORMAT}\nversion {}\ninstallation {}\ninterpreter {}\nproject {}",
            linked.version,
            linked.base_prefix,
            linked.executable,
            inputs.root.display()
        );
        let packages = format!("{}\n{LOCK_BEGINS}\n{}", inputs.manifest, inputs.lock);
        Self { python, packages, user_packages: inputs.user_packages.to_owned() }
    }

    /// Returns the stamp of the same environment without the packages that a user added.
    pub(super) fn without_user_packages(&self) -> Self {
        Self { user_packages: String::new(), ..self.clone() }
    }

    fn text(&self) -> String {
        let Self { python, packages, user_packages } = self;
        format!("{python}\n{MANIFEST_BEGINS}\n{packages}\n{USER_PACKAGES_BEGIN}\n{user_packages}")
    }

    /// Compares a virtual environment, without running anything.
    pub(super) fn compare(&self, venv: &Path) -> Fit {
        if fs::symlink_metadata(venv).is_err() {
            return Fit::Absent;
        }
        let Ok(found) = fs::read_to_string(venv.join(FILE)) else {
            let why = if venv.join(MAKING).exists() {
                "the last attempt did not finish"
            } else {
                "dmprl did not create it"
            };
            return Fit::Unusable(why.to_owned());
        };
        // `exists` follows the link, so it is false if that Python was uninstalled.
        if !venv.join("bin/python").exists() {
            return Fit::Unusable("its interpreter does not exist any more".to_owned());
        }
        if found == self.text() {
            return Fit::Ready;
        }
        let python = found.split(MANIFEST_BEGINS).next().unwrap_or_default().trim_end();
        if python == self.python {
            let rest = found.strip_prefix(&self.without_user_packages().text());
            return if rest.is_some() { Fit::OtherUserPackages } else { Fit::OtherPackages };
        }
        let was = python.lines().zip(self.python.lines()).find(|(was, wanted)| was != wanted);
        let (was, wanted) = was.unwrap_or(("nothing", "something"));
        Fit::Unusable(format!("created for {was}, expected {wanted}"))
    }

    /// Marks a virtual environment as complete.
    pub(super) fn write(&self, venv: &Path) -> Result<()> {
        let temporary = venv.join(format!("{FILE}.part"));
        fs::write(&temporary, self.text())
            .and_then(|()| fs::rename(&temporary, venv.join(FILE)))
            .and_then(|()| remove_if_present(&venv.join(MAKING)))
            .with_context(|| format!("cannot write {}", venv.join(FILE).display()))
    }
}

/// Returns true if dmprl created this virtual environment, completely or not.
pub(super) fn is_marked(venv: &Path) -> bool {
    venv.join(FILE).exists() || venv.join(MAKING).exists()
}

/// Creates the directory, marked as incomplete.
pub(super) fn begin(venv: &Path) -> Result<()> {
    fs::create_dir(venv)
        .and_then(|()| fs::write(venv.join(MAKING), "dmprl is creating this directory\n"))
        .with_context(|| format!("cannot create {}", venv.display()))
}

/// Marks a virtual environment as incomplete.
pub(super) fn remove(venv: &Path) -> Result<()> {
    let path: PathBuf = venv.join(FILE);
    fs::write(venv.join(MAKING), "dmprl is changing this directory\n")
        .and_then(|()| remove_if_present(&path))
        .with_context(|| format!("cannot remove {}", path.display()))
}

fn remove_if_present(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINKED: LinkedPython = LinkedPython {
        executable: "/opt/a/bin/python3",
        version: "3.11.7 (main) [GCC]",
        base_prefix: "/opt/a",
        library_dir: "/opt/a/lib",
    };

    fn inputs(root: &Path) -> Inputs<'_> {
        let manifest = "[project]\nname = 'dmprl'\n";
        Inputs { root, manifest, lock: "numpy==2.5.0\n", user_packages: "torch\n" }
    }

    fn unfinished_venv() -> (tempfile::TempDir, PathBuf, Stamp) {
        let directory = tempfile::tempdir().unwrap();
        let venv = directory.path().join(".venv");
        begin(&venv).unwrap();
        fs::create_dir(venv.join("bin")).unwrap();
        fs::write(venv.join("bin/python"), "").unwrap();
        let stamp = Stamp::new(&LINKED, &inputs(directory.path()));
        (directory, venv, stamp)
    }

    fn why(fit: Fit) -> String {
        let Fit::Unusable(why) = fit else { panic!("{fit:?} should be Unusable") };
        why
    }

    #[test]
    fn incomplete_environment_is_not_ready() {
        let (_directory, venv, stamp) = unfinished_venv();
        assert_eq!(why(stamp.compare(&venv)), "the last attempt did not finish");
        stamp.write(&venv).unwrap();
        assert_eq!(stamp.compare(&venv), Fit::Ready);
        remove(&venv).unwrap();
        assert_eq!(why(stamp.compare(&venv)), "the last attempt did not finish");
    }

    #[test]
    fn absent_and_foreign_environments_differ() {
        let (_directory, venv, stamp) = unfinished_venv();
        assert_eq!(stamp.compare(&venv.join("none")), Fit::Absent);
        fs::remove_file(venv.join(MAKING)).unwrap();
        assert_eq!(why(stamp.compare(&venv)), "dmprl did not create it");
    }

    #[test]
    fn changed_requirements_need_no_new_environment() {
        let (directory, venv, stamp) = unfinished_venv();
        stamp.write(&venv).unwrap();
        let same = inputs(directory.path());
        for changed in [
            Inputs { manifest: "[project]\nname = 'other'\n", ..same },
            Inputs { lock: "numpy==2.5.1\n", ..inputs(directory.path()) },
        ] {
            assert_eq!(Stamp::new(&LINKED, &changed).compare(&venv), Fit::OtherPackages);
        }
    }

    #[test]
    fn changed_list_of_added_packages_needs_only_their_installation() {
        let (directory, venv, stamp) = unfinished_venv();
        for list in ["", "torch\npandas\n"] {
            stamp.write(&venv).unwrap();
            let changed = Inputs { user_packages: list, ..inputs(directory.path()) };
            let changed = Stamp::new(&LINKED, &changed);
            assert_eq!(changed.compare(&venv), Fit::OtherUserPackages);
            changed.without_user_packages().write(&venv).unwrap();
            let is_empty = list.is_empty();
            assert_eq!(changed.compare(&venv) == Fit::Ready, is_empty);
        }
    }

    #[test]
    fn another_installation_of_the_same_version_is_unusable() {
        let (directory, venv, stamp) = unfinished_venv();
        stamp.write(&venv).unwrap();
        let other = LinkedPython { base_prefix: "/usr", ..LINKED };
        let other = Stamp::new(&other, &inputs(directory.path()));
        assert_eq!(
            why(other.compare(&venv)),
            "created for installation /opt/a, expected installation /usr"
        );
    }

    #[test]
    fn moved_project_is_unusable() {
        let (_directory, venv, stamp) = unfinished_venv();
        stamp.write(&venv).unwrap();
        let moved = Stamp::new(&LINKED, &inputs(Path::new("/elsewhere")));
        assert!(why(moved.compare(&venv)).ends_with("expected project /elsewhere"));
    }

    #[test]
    fn uninstalled_python_is_unusable() {
        let (_directory, venv, stamp) = unfinished_venv();
        stamp.write(&venv).unwrap();
        fs::remove_file(venv.join("bin/python")).unwrap();
        std::os::unix::fs::symlink("/no/such/python", venv.join("bin/python")).unwrap();
        assert_eq!(why(stamp.compare(&venv)), "its interpreter does not exist any more");
    }
}
