//! The locked versions and hashes of the packages that dmprl installs: `envs_py/locks`.

use std::{
    fs,
    path::{Path, PathBuf},
};

use super::requirement::Requirement;

/// Folder in the Python package's project.
const FOLDER: &str = "locks";

/// Returns the lock of the packages that every environment has.
pub(super) fn base(package: &Path) -> PathBuf {
    package.join(FOLDER).join("base.txt")
}

/// Returns the lock of an optional part, if it has one: the parts that dmprl installs by itself.
pub(super) fn of_extra(package: &Path, extra: &str) -> Option<PathBuf> {
    let path = package.join(FOLDER).join(format!("{extra}.txt"));
    path.is_file().then_some(path)
}

/// Returns the packages of all locks.
pub(super) fn all_packages(package: &Path) -> Vec<Requirement> {
    let files = fs::read_dir(package.join(FOLDER)).into_iter().flatten().flatten();
    let texts = files.filter_map(|file| fs::read_to_string(file.path()).ok());
    texts.flat_map(|text| packages(&text)).collect()
}

/// Reads the packages of a lock: lines such as `numpy==2.5.0 \`, followed by their hashes.
fn packages(text: &str) -> Vec<Requirement> {
    let named = text.lines().filter(|line| line.starts_with(|it: char| it.is_alphanumeric()));
    named.map(|line| Requirement::of_line(line.trim_end_matches('\\'))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packages_of_a_lock_are_read() {
        let text = "# a comment\nnumpy==2.4.6 ; python_full_version < '3.12' \\\n    \
                    --hash=sha256:00\npyopengl==3.1.10 \\\n    --hash=sha256:11\n";
        let names: Vec<_> = packages(text).iter().filter_map(Requirement::name).collect();
        assert_eq!(names, ["numpy", "pyopengl"]);
    }
}
