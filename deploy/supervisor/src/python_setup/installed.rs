//! Reads which packages a virtual environment has, from its files: its interpreter may be gone.

use std::{
    fs,
    path::{Path, PathBuf},
};

use serde::Deserialize;

use super::requirement::{EDITABLE, Requirement, normalised};

/// Packages that `venv` installs.
const OF_VENV: [&str; 3] = ["pip", "setuptools", "wheel"];

/// An installed package.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct InstalledPackage {
    /// The normalised name.
    pub name: String,
    /// The requirement that installs it again, with its version.
    pub requirement: String,
    /// False if it was installed only because another package needs it.
    is_requested: bool,
}

/// Origin of a package that is not from an index (PEP 610).
#[derive(Deserialize)]
struct Origin {
    url: String,
    dir_info: Option<DirInfo>,
    vcs_info: Option<VcsInfo>,
}

#[derive(Deserialize)]
struct DirInfo {
    #[serde(default)]
    editable: bool,
}

#[derive(Deserialize)]
struct VcsInfo {
    vcs: String,
    commit_id: String,
}

/// Returns the packages of an environment, sorted by name; empty if it has none or is no
/// environment.
pub(super) fn installed_packages(venv: &Path) -> Vec<InstalledPackage> {
    let folders = entries(&venv.join("lib")).map(|python| python.join("site-packages"));
    let mut found: Vec<InstalledPackage> =
        folders.flat_map(|folder| entries(&folder)).filter_map(|path| of_folder(&path)).collect();
    found.sort_by(|one, other| one.name.cmp(&other.name));
    found
}

/// Returns the packages that were installed with pip by name, except those in `known`.
pub(super) fn installed_by_hand(venv: &Path, known: &[Requirement]) -> Vec<InstalledPackage> {
    let is_known = |package: &InstalledPackage| {
        let requirement = Requirement::of_line(&package.requirement);
        OF_VENV.contains(&package.name.as_str())
            || known.iter().any(|known| {
                known.name().as_deref() == Some(&package.name) || known.replaces(&requirement)
            })
    };
    let mut packages = installed_packages(venv);
    packages.retain(|package| package.is_requested && !is_known(package));
    packages
}

fn of_folder(folder: &Path) -> Option<InstalledPackage> {
    let stem = folder.file_name()?.to_str()?.strip_suffix(".dist-info")?;
    let (name, version) = stem.split_once('-')?;
    let origin = fs::read_to_string(folder.join("direct_url.json")).ok();
    let origin = origin.and_then(|text| serde_json::from_str(&text).ok());
    let name = normalised(name);
    Some(InstalledPackage {
        requirement: match origin {
            Some(origin) => requirement_of(&name, &origin),
            None => format!("{name}=={version}"),
        },
        name,
        // pip writes this file for packages that were named on its command line.
        is_requested: folder.join("REQUESTED").exists(),
    })
}

fn requirement_of(name: &str, origin: &Origin) -> String {
    let path = origin.url.strip_prefix("file://");
    match (path, &origin.dir_info, &origin.vcs_info) {
        (Some(path), Some(DirInfo { editable: true }), _) => format!("{EDITABLE}{path}"),
        (Some(path), ..) => path.to_owned(),
        (_, _, Some(VcsInfo { vcs, commit_id })) => {
            format!("{name} @ {vcs}+{}@{commit_id}", origin.url)
        }
        _ => format!("{name} @ {}", origin.url),
    }
}

fn entries(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plant(venv: &Path, folder: &str, files: &[(&str, &str)]) {
        let folder = venv.join("lib/python3.11/site-packages").join(folder);
        fs::create_dir_all(&folder).unwrap();
        files.iter().for_each(|(name, text)| fs::write(folder.join(name), text).unwrap());
    }

    #[test]
    fn packages_by_hand_are_those_that_were_named_and_that_we_do_not_know() {
        let venv = tempfile::tempdir().unwrap();
        let venv = venv.path();
        let requested = ("REQUESTED", "");
        let editable = r#"{"url": "file:///home/me/arm", "dir_info": {"editable": true}}"#;
        let commit = r#"{"url": "https://example.org/x.git",
                         "vcs_info": {"vcs": "git", "commit_id": "abc"}}"#;
        plant(venv, "pip-23.2.1.dist-info", &[requested]);
        plant(venv, "numpy-2.5.0.dist-info", &[requested]);
        plant(venv, "six-1.17.0.dist-info", &[]);
        plant(venv, "Py_Yaml-6.0.dist-info", &[requested]);
        plant(venv, "arm-1.0.dist-info", &[requested, ("direct_url.json", editable)]);
        plant(venv, "x-2.dist-info", &[requested, ("direct_url.json", commit)]);
        plant(venv, "numpy", &[]);
        let known = [Requirement::of_line("numpy>=2"), Requirement::of_line("/home/me/other")];
        let by_hand = installed_by_hand(venv, &known);
        let by_hand: Vec<&str> = by_hand.iter().map(|it| it.requirement.as_str()).collect();
        let expected = ["-e /home/me/arm", "py-yaml==6.0", "x @ git+https://example.org/x.git@abc"];
        assert_eq!(by_hand, expected);
        let known = [Requirement::of_line("/home/me/arm")];
        assert!(installed_by_hand(venv, &known).iter().all(|package| package.name != "arm"));
        assert_eq!(installed_by_hand(&venv.join("none"), &[]), []);
    }
}
