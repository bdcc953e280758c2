//! The runs below a directory, found again and again: one may begin at any time.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::watched::Watched;
use crate::failure::wrong_use;
use crate::run_directory::RunDirectory;

/// Between two looks for new runs, at least,
const WALK_INTERVAL: Duration = Duration::from_secs(2);
/// and so many times what a look takes, where there is much to look through.
const WALK_REST: u32 = 50;
/// Folders between the directory and a run: a sweep has three.
const DEPTH_MAX: usize = 6;
/// Entries looked at in one walk: a directory with more is not one of runs.
const ENTRIES_MAX: usize = 100_000;
/// Runs that are shown; the rest is counted.
pub const RUNS_MAX: usize = 2_000;

/// The runs of a directory, or the one run that it is, by their paths below it.
#[derive(Debug)]
pub struct Catalogue {
    root: PathBuf,
    /// By what the page calls them; nothing else is ever opened for a request.
    pub runs: BTreeMap<String, Watched>,
    /// Runs beyond [`RUNS_MAX`].
    pub left_out: usize,
    /// When it is time to look again; none before the first.
    due: Option<Instant>,
}

impl Catalogue {
    /// # Errors
    /// Wrong use: there is no such directory.
    pub fn new(root: &Path) -> anyhow::Result<Self> {
        let resolved = fs::canonicalize(root).ok().filter(|path| path.is_dir());
        let root = resolved.ok_or_else(|| {
            wrong_use(format!(
                "there is no directory {}; name a run, or a directory with runs below it",
                root.display()
            ))
        })?;
        Ok(Self { root, runs: BTreeMap::new(), left_out: 0, due: None })
    }

    /// The directory, absolute.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Looks for runs that have come or gone, if that was not done just now.
    pub fn walk(&mut self) {
        let begun = Instant::now();
        if self.due.is_some_and(|due| begun < due) {
            return;
        }
        let mut walk = Walk { found: Vec::new(), entries: 0 };
        walk.visit(&self.root, DEPTH_MAX);
        walk.found.sort();
        self.left_out = walk.found.len().saturating_sub(RUNS_MAX);
        walk.found.truncate(RUNS_MAX);
        let mut before = std::mem::take(&mut self.runs);
        for path in walk.found {
            let name = self.name_of(&path);
            let known = before.remove(&name);
            let watched = known.or_else(|| RunDirectory::open(&path).ok().map(Watched::new));
            self.runs.extend(watched.map(|watched| (name, watched)));
        }
        self.due = begun.checked_add(WALK_INTERVAL.max(begun.elapsed() * WALK_REST));
    }

    fn name_of(&self, path: &Path) -> String {
        match path.strip_prefix(&self.root).map(Path::to_string_lossy) {
            Ok(below) if !below.is_empty() => below.into_owned(),
            _ => self.root.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        }
    }
}

struct Walk {
    found: Vec<PathBuf>,
    entries: usize,
}

impl Walk {
    /// Links are not followed: what they lead to is not below the directory.
    fn visit(&mut self, folder: &Path, depth: usize) {
        if folder.join("manifest.json").is_file() && folder.join("config.toml").is_file() {
            self.found.push(folder.to_owned());
            return;
        }
        // One that cannot be read, or has just gone, holds no run for us.
        let Ok(entries) = fs::read_dir(folder) else { return };
        for entry in entries.flatten() {
            self.entries += 1;
            if self.entries > ENTRIES_MAX || depth == 0 {
                return;
            }
            if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                self.visit(&entry.path(), depth - 1);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;
    use crate::run_directory::Manifest;

    fn make(path: &Path) {
        let manifest = Manifest::new(None).unwrap();
        RunDirectory::create(path, &Default::default(), &manifest).unwrap();
    }

    fn names(catalogue: &Catalogue) -> Vec<&str> {
        catalogue.runs.keys().map(String::as_str).collect()
    }

    #[test]
    fn runs_are_found_at_any_depth_and_nothing_behind_a_link() {
        let folder = tempfile::tempdir().unwrap();
        let elsewhere = tempfile::tempdir().unwrap();
        make(&folder.path().join("alone"));
        make(&folder.path().join("sweep/reacher/td3/seed-1"));
        make(&elsewhere.path().join("foreign"));
        symlink(elsewhere.path(), folder.path().join("link")).unwrap();
        let mut catalogue = Catalogue::new(folder.path()).unwrap();
        catalogue.walk();
        assert_eq!(names(&catalogue), ["alone", "sweep/reacher/td3/seed-1"]);
        assert_eq!(catalogue.left_out, 0);
    }

    #[test]
    fn one_run_is_called_by_its_own_name() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("mine");
        make(&run);
        let mut catalogue = Catalogue::new(&run).unwrap();
        catalogue.walk();
        assert_eq!(names(&catalogue), ["mine"]);
    }
}
