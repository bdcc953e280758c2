//! Requirements in pip's syntax: `numpy>=2`, `dmprl[video]`, `name @ URL`, a path, `-e PATH`.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

/// Name of our own package. pip is never asked for it, because an index may have another package
/// of this name.
pub(super) const OURS: &str = "dmprl";
/// Start of a requirement whose folder is used in place.
pub(super) const EDITABLE: &str = "-e ";
/// Characters that end a package's name and extras.
const AFTER_NAME: [char; 7] = ['<', '>', '=', '!', '~', ';', '@'];

/// A package that a user added, as a line of the list of added packages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Requirement(String);

impl Requirement {
    /// Takes a line of the list.
    pub(super) fn of_line(line: &str) -> Self {
        Self(line.trim().to_owned())
    }

    /// Parses an argument of the command line. Paths become absolute, because the list is used in
    /// other working directories.
    ///
    /// # Errors
    /// It is an option of pip, it is our own package, or the path does not exist.
    pub(super) fn of_argument(argument: &str, is_editable: bool) -> Result<Self> {
        let argument = argument.trim();
        if argument.is_empty() || argument.starts_with('-') || argument.contains('\n') {
            bail!("`{argument}` is not a package; expected a name, a path or a URL");
        }
        if is_editable || is_path(argument) {
            let path = PathBuf::from(argument)
                .canonicalize()
                .with_context(|| format!("cannot find the package `{argument}`"))?;
            let editable = if is_editable { EDITABLE } else { "" };
            return Ok(Self(format!("{editable}{}", path.display())));
        }
        let requirement = Self(argument.to_owned());
        if requirement.name().as_deref() == Some(OURS) && requirement.extras().is_empty() {
            bail!("{OURS} is installed already; `{OURS}[EXTRA]` adds an optional part of it");
        }
        Ok(requirement)
    }

    /// Parses an argument that names an entry of the list. Its path need not exist any more.
    pub(super) fn to_remove(argument: &str) -> Self {
        let path = || std::path::absolute(argument).ok();
        let path = if is_path(argument) { path() } else { None };
        Self::of_argument(argument, false).unwrap_or_else(|_| {
            Self(path.map_or(argument.to_owned(), |it| it.display().to_string()))
        })
    }

    /// Returns the line of the list.
    pub(super) fn line(&self) -> &str {
        &self.0
    }

    /// Returns the path, if it is one.
    pub(super) fn path(&self) -> Option<&Path> {
        let path = self.0.strip_prefix(EDITABLE).unwrap_or(&self.0).trim();
        path.starts_with('/').then(|| Path::new(path))
    }

    /// Returns the normalised name; `None` for a path or a bare URL.
    pub(super) fn name(&self) -> Option<String> {
        let name = self.head().split('[').next()?.trim();
        let is_name = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
        (!name.is_empty() && name.bytes().all(is_name)).then(|| normalised(name))
    }

    /// Returns the extras in brackets after the name.
    pub(super) fn extras(&self) -> Vec<String> {
        let list = self.head().split_once('[').and_then(|(_, rest)| rest.split_once(']'));
        let names = list.map_or("", |(list, _)| list).split(',').map(str::trim);
        names.filter(|name| !name.is_empty()).map(normalised).collect()
    }

    /// Returns true if both are for the same package and extras, so that one replaces the other.
    pub(super) fn replaces(&self, other: &Self) -> bool {
        match (self.name(), other.name()) {
            (Some(name), Some(others)) => name == others && self.extras() == other.extras(),
            _ => self.0 == other.0 || (self.path().is_some() && self.path() == other.path()),
        }
    }

    fn head(&self) -> &str {
        self.0.split(AFTER_NAME).next().unwrap_or("")
    }
}

/// Normalises a package's name as pip does: `Foo_Bar.baz` is `foo-bar-baz`.
pub(super) fn normalised(name: &str) -> String {
    let parts = name.split(['-', '_', '.']).filter(|part| !part.is_empty());
    parts.collect::<Vec<_>>().join("-").to_lowercase()
}

/// Tells a path from a name, by pip's rules: a folder is written with a slash or a leading dot.
fn is_path(argument: &str) -> bool {
    let path = Path::new(argument);
    let is_archive = [".whl", ".tar.gz", ".zip"].iter().any(|end| argument.ends_with(end));
    let is_url = argument.contains("://") || argument.contains('@');
    let looks_like_path = argument.contains('/') || argument.starts_with('.');
    !is_url && (looks_like_path || (is_archive && path.exists()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(argument: &str) -> Requirement {
        Requirement::of_argument(argument, false).unwrap()
    }

    #[test]
    fn name_and_extras_are_read_from_every_form() {
        for (text, name, extras) in [
            ("Foo_Bar.baz", "foo-bar-baz", ""),
            ("torch >=2,<3", "torch", ""),
            ("dmprl[panda-gym, robotics]", "dmprl", "panda-gym robotics"),
            ("a[x]~=1.0 ; python_version < '3.12'", "a", "x"),
            ("other @ file:///wheels/other.whl", "other", ""),
        ] {
            let requirement = parsed(text);
            assert_eq!(requirement.name().as_deref(), Some(name), "{text}");
            assert_eq!(requirement.extras().join(" "), extras, "{text}");
        }
        assert_eq!(parsed("git+https://example.org/a.git").name(), None);
    }

    #[test]
    fn paths_become_absolute_and_options_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let text = folder.path().join(".").display().to_string();
        let path = folder.path().canonicalize().unwrap();
        assert_eq!(parsed(&text).line(), path.display().to_string());
        let editable = Requirement::of_argument(&text, true).unwrap();
        assert_eq!(editable.line(), format!("-e {}", path.display()));
        assert_eq!((editable.path(), editable.name()), (Some(path.as_path()), None));
        assert!(editable.replaces(&parsed(&text)));
        for refused in ["--index-url=x", "", "dmprl", "dmprl>=1", "./no/such/folder"] {
            assert!(Requirement::of_argument(refused, false).is_err(), "{refused}");
        }
    }

    #[test]
    fn another_version_replaces_and_another_extra_does_not() {
        assert!(parsed("Torch>=2").replaces(&parsed("torch")));
        assert!(!parsed("dmprl[video]").replaces(&parsed("dmprl[search]")));
        assert!(!parsed("torch").replaces(&parsed("torchvision")));
    }
}
