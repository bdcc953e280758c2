//! What `.venv` was made from, in a file inside it, written last.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result};
use dmprl_actors::python_env::LinkedPython;

/// Raised when what [`super::ensure`] puts into `.venv` changes other than by `pyproject.toml`.
const FORMAT: u32 = 1;
const FILE: &str = "dmprl-stamp.txt";
/// Written first, so that a `.venv` whose making was killed is known as ours.
pub(super) const MAKING: &str = "dmprl-making.txt";
const MANIFEST_BEGINS: &str = "--- envs_py/pyproject.toml ---";

/// Everything that `.venv` depends on, as text: compared whole, readable by whoever wonders.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Stamp {
    python: String,
    manifest: String,
}

/// How what is on disk fits what is wanted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Fit {
    /// Use it.
    Ready,
    /// The right Python, but the package's requirements have changed.
    OtherPackages,
    /// There is nothing.
    Absent,
    /// It must be made anew, because …
    Unusable(String),
}

impl Stamp {
    /// - `root`: the project's directory; packages and scripts in `.venv` hold absolute paths.
    /// - `manifest`: content of `envs_py/pyproject.toml`.
    pub(super) fn new(linked: &LinkedPython, root: &Path, manifest: &str) -> Self {
        let python = format!(
            "format {FORMAT}\nversion {}\ninstallation {}\ninterpreter {}\nproject {}",
            linked.version,
            linked.base_prefix,
            linked.executable,
            root.display()
        );
        Self { python, manifest: manifest.to_owned() }
    }

    fn text(&self) -> String {
        format!("{}\n{MANIFEST_BEGINS}\n{}", self.python, self.manifest)
    }

    /// Looks at a virtual environment without running anything.
    pub(super) fn compare(&self, venv: &Path) -> Fit {
        if fs::symlink_metadata(venv).is_err() {
            return Fit::Absent;
        }
        let Ok(found) = fs::read_to_string(venv.join(FILE)) else {
            let why = if venv.join(MAKING).exists() {
                "the last attempt did not finish"
            } else {
                "it was not made by dmprl"
            };
            return Fit::Unusable(why.to_owned());
        };
        // Follows the link: false when that Python was uninstalled.
        if !venv.join("bin/python").exists() {
            return Fit::Unusable("its interpreter is gone".to_owned());
        }
        if found == self.text() {
            return Fit::Ready;
        }
        let python = found.split(MANIFEST_BEGINS).next().unwrap_or_default().trim_end();
        if python == self.python {
            return Fit::OtherPackages;
        }
        let was = python.lines().zip(self.python.lines()).find(|(was, wanted)| was != wanted);
        let (was, wanted) = was.unwrap_or(("nothing", "something"));
        Fit::Unusable(format!("it was made for {was}, needed is {wanted}"))
    }

    /// What an extra of the package needs.
    pub(super) fn requirements_of(&self, extra: &str) -> Result<Vec<String>> {
        let manifest: toml::Table = self.manifest.parse().context("envs_py/pyproject.toml")?;
        let extras = manifest.get("project").and_then(|it| it.get("optional-dependencies"));
        let requirements = extras.and_then(|extras| extras.get(extra)?.as_array());
        let requirements = requirements
            .with_context(|| format!("envs_py/pyproject.toml has no extra `{extra}`"))?;
        Ok(requirements.iter().filter_map(|it| it.as_str().map(str::to_owned)).collect())
    }

    /// Whether an extra of the package was installed with these requirements.
    pub(super) fn has_extra(&self, venv: &Path, extra: &str) -> bool {
        fs::read_to_string(extra_file(venv, extra)).is_ok_and(|found| found == self.text())
    }

    /// Declares an extra installed.
    pub(super) fn write_extra(&self, venv: &Path, extra: &str) -> Result<()> {
        let path = extra_file(venv, extra);
        fs::write(&path, self.text()).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Declares a virtual environment complete.
    pub(super) fn write(&self, venv: &Path) -> Result<()> {
        let temporary = venv.join(format!("{FILE}.part"));
        fs::write(&temporary, self.text())
            .and_then(|()| fs::rename(&temporary, venv.join(FILE)))
            .and_then(|()| remove_if_present(&venv.join(MAKING)))
            .with_context(|| format!("cannot write {}", venv.join(FILE).display()))
    }
}

fn extra_file(venv: &Path, extra: &str) -> PathBuf {
    venv.join(format!("dmprl-stamp-{extra}.txt"))
}

/// Makes the directory, marked as being worked on.
pub(super) fn begin(venv: &Path) -> Result<()> {
    fs::create_dir(venv)
        .and_then(|()| fs::write(venv.join(MAKING), "dmprl is making this directory\n"))
        .with_context(|| format!("cannot make {}", venv.display()))
}

/// Declares a virtual environment incomplete.
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

    fn made() -> (tempfile::TempDir, PathBuf, Stamp) {
        let directory = tempfile::tempdir().unwrap();
        let venv = directory.path().join(".venv");
        begin(&venv).unwrap();
        fs::create_dir(venv.join("bin")).unwrap();
        fs::write(venv.join("bin/python"), "").unwrap();
        let stamp = Stamp::new(&LINKED, directory.path(), "[project]\nname = 'dmprl'\n");
        (directory, venv, stamp)
    }

    fn why(fit: Fit) -> String {
        let Fit::Unusable(why) = fit else { panic!("{fit:?} should be Unusable") };
        why
    }

    #[test]
    fn half_made_environment_is_not_ready() {
        let (_directory, venv, stamp) = made();
        assert_eq!(why(stamp.compare(&venv)), "the last attempt did not finish");
        stamp.write(&venv).unwrap();
        assert_eq!(stamp.compare(&venv), Fit::Ready);
        remove(&venv).unwrap();
        assert_eq!(why(stamp.compare(&venv)), "the last attempt did not finish");
    }

    #[test]
    fn an_extra_is_there_for_the_requirements_it_was_installed_with() {
        let (directory, venv, stamp) = made();
        assert!(!stamp.has_extra(&venv, "video"));
        stamp.write_extra(&venv, "video").unwrap();
        assert!(stamp.requirements_of("video").is_err(), "this package has none");
        assert!(stamp.has_extra(&venv, "video") && !stamp.has_extra(&venv, "other"));
        let changed = Stamp::new(&LINKED, directory.path(), "[project]\nname = 'other'\n");
        assert!(!changed.has_extra(&venv, "video"));
    }

    #[test]
    fn absent_and_foreign_environments_are_told_apart() {
        let (_directory, venv, stamp) = made();
        assert_eq!(stamp.compare(&venv.join("none")), Fit::Absent);
        fs::remove_file(venv.join(MAKING)).unwrap();
        assert_eq!(why(stamp.compare(&venv)), "it was not made by dmprl");
    }

    #[test]
    fn changed_requirements_need_no_new_environment() {
        let (directory, venv, stamp) = made();
        stamp.write(&venv).unwrap();
        let changed = Stamp::new(&LINKED, directory.path(), "[project]\nname = 'other'\n");
        assert_eq!(changed.compare(&venv), Fit::OtherPackages);
    }

    #[test]
    fn another_installation_of_the_same_version_is_unusable() {
        let (directory, venv, stamp) = made();
        stamp.write(&venv).unwrap();
        let other = LinkedPython { base_prefix: "/usr", ..LINKED };
        let other = Stamp::new(&other, directory.path(), &stamp.manifest);
        assert_eq!(
            why(other.compare(&venv)),
            "it was made for installation /opt/a, needed is installation /usr"
        );
    }

    #[test]
    fn moved_project_is_unusable() {
        let (_directory, venv, stamp) = made();
        stamp.write(&venv).unwrap();
        let moved = Stamp::new(&LINKED, Path::new("/elsewhere"), &stamp.manifest);
        assert!(why(moved.compare(&venv)).ends_with("needed is project /elsewhere"));
    }

    #[test]
    fn uninstalled_python_is_unusable() {
        let (_directory, venv, stamp) = made();
        stamp.write(&venv).unwrap();
        fs::remove_file(venv.join("bin/python")).unwrap();
        std::os::unix::fs::symlink("/no/such/python", venv.join("bin/python")).unwrap();
        assert_eq!(why(stamp.compare(&venv)), "its interpreter is gone");
    }
}
