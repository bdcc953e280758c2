//! Searches a directory for runs, repeatedly, because runs can start at any time.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use dmprl_run::RunDirectory;
use dmprl_run::failure::wrong_use;

use super::cached_run::CachedRun;

/// Minimum interval between two searches for new runs.
const SCAN_INTERVAL: Duration = Duration::from_secs(2);
/// Minimum interval between two searches as a multiple of the duration of one, which limits the
/// cost of large directories.
const SCAN_PAUSE_FACTOR: u32 = 50;
/// Maximum depth of a run below the directory; a sweep needs three or four.
const DEPTH_MAX: usize = 6;
/// Maximum number of directory entries visited per search. A directory with more hardly contains
/// only runs.
const ENTRIES_MAX: usize = 100_000;
/// Maximum number of runs listed; the others are counted.
const RUNS_MAX: usize = 2_000;

/// The runs below a directory, or the directory itself if it is a run.
#[derive(Debug)]
pub struct Catalogue {
    root: PathBuf,
    /// Runs by name, which is the path relative to the directory. Requests can open only these.
    pub runs: BTreeMap<String, CachedRun>,
    /// Number of runs beyond [`RUNS_MAX`].
    pub left_out: usize,
    /// Time of the next search; `None` before the first.
    due: Option<Instant>,
}

impl Catalogue {
    /// Creates a catalogue of the runs below `root`.
    ///
    /// # Errors
    /// Wrong use: the directory does not exist.
    pub fn new(root: &Path) -> anyhow::Result<Self> {
        let resolved = fs::canonicalize(root).ok().filter(|path| path.is_dir());
        let root = resolved.ok_or_else(|| {
            wrong_use(format!(
                "there is no directory {}; give a run, or a directory that contains runs",
                root.display()
            ))
        })?;
        Ok(Self { root, runs: BTreeMap::new(), left_out: 0, due: None })
    }

    /// Absolute path of the directory.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Searches for new and removed runs, unless the last search was recent.
    pub fn scan(&mut self) {
        let started = Instant::now();
        if self.due.is_some_and(|due| started < due) {
            return;
        }
        let mut scan = Scan { found: Vec::new(), entries: 0 };
        scan.visit(&self.root, DEPTH_MAX);
        scan.found.sort();
        self.left_out = scan.found.len().saturating_sub(RUNS_MAX);
        scan.found.truncate(RUNS_MAX);
        let mut before = std::mem::take(&mut self.runs);
        for path in scan.found {
            let name = self.name_of(&path);
            let known = before.remove(&name);
            let run = known.or_else(|| RunDirectory::open(&path).ok().map(CachedRun::new));
            self.runs.extend(run.map(|run| (name, run)));
        }
        self.due = started.checked_add(SCAN_INTERVAL.max(started.elapsed() * SCAN_PAUSE_FACTOR));
    }

    fn name_of(&self, path: &Path) -> String {
        match path.strip_prefix(&self.root).map(Path::to_string_lossy) {
            Ok(below) if !below.is_empty() => below.into_owned(),
            _ => self.root.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        }
    }
}

/// A search for runs.
struct Scan {
    found: Vec<PathBuf>,
    entries: usize,
}

impl Scan {
    /// Collects the runs below a folder. Links are not followed, as they can lead out of it.
    fn visit(&mut self, folder: &Path, depth: usize) {
        if folder.join("manifest.json").is_file() && folder.join("config.toml").is_file() {
            self.found.push(folder.to_owned());
            return;
        }
        // Skips folders that cannot be read or have just been removed.
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
    use dmprl_run::Manifest;

    fn make(path: &Path) {
        let manifest = Manifest::new(None).unwrap();
        RunDirectory::create(path, &Default::default(), &manifest).unwrap();
    }

    fn names(catalogue: &Catalogue) -> Vec<&str> {
        catalogue.runs.keys().map(String::as_str).collect()
    }

    #[test]
    fn runs_are_found_at_any_depth_but_not_through_links() {
        let folder = tempfile::tempdir().unwrap();
        let elsewhere = tempfile::tempdir().unwrap();
        make(&folder.path().join("alone"));
        make(&folder.path().join("sweep/reacher/td3/seed-1"));
        make(&elsewhere.path().join("foreign"));
        symlink(elsewhere.path(), folder.path().join("link")).unwrap();
        let mut catalogue = Catalogue::new(folder.path()).unwrap();
        catalogue.scan();
        assert_eq!(names(&catalogue), ["alone", "sweep/reacher/td3/seed-1"]);
        assert_eq!(catalogue.left_out, 0);
    }

    #[test]
    fn directory_that_is_a_run_is_listed_by_its_own_name() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("mine");
        make(&run);
        let mut catalogue = Catalogue::new(&run).unwrap();
        catalogue.scan();
        assert_eq!(names(&catalogue), ["mine"]);
    }
}
