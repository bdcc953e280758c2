//! The run's private shared-memory directory: the one place that makes, finds and removes it.
//!
//! A user's domains lie in `dmprl-<uid>`. Where shared memory is everybody's, somebody else can
//! take that name first; then they lie in `dmprl-<uid>-<random>`, which nobody can guess.

use std::fs::Metadata;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dmprl_shared::transport::shared_memory::{Domain, Leftover, abandoned, remove_abandoned};

use crate::run_directory::{Manifest, random_u64};
use crate::terminal::say;

/// Digits of the random part of a name: the domain's path must stay short.
const RANDOM_DIGITS: usize = 8;

/// A file system for shared memory, and whose domains are looked for in it.
#[derive(Debug, Clone)]
pub(crate) struct Place {
    base: PathBuf,
    user: u32,
}

impl Place {
    /// This user's: memory-backed when the system has it.
    pub(crate) fn new() -> Self {
        let shared_memory = Path::new("/dev/shm");
        let base =
            if shared_memory.is_dir() { shared_memory.to_owned() } else { std::env::temp_dir() };
        Self { base, user: rustix::process::geteuid().as_raw() }
    }

    /// The file system's directory.
    pub(crate) fn base(&self) -> &Path {
        &self.base
    }

    /// The directory of this user's domains, and another user's id if that one has it.
    pub(crate) fn standard(&self) -> (PathBuf, Option<u32>) {
        let path = self.base.join(format!("dmprl-{}", self.user));
        let owner = path.symlink_metadata().ok().map(|metadata| metadata.uid());
        (path, owner.filter(|&owner| owner != self.user))
    }

    /// What dead runs of this user have left. Changes nothing.
    ///
    /// # Errors
    /// A directory of this user's is open to others, or cannot be read.
    pub(crate) fn leftovers(&self) -> anyhow::Result<Vec<Leftover>> {
        self.of_each_parent(abandoned, "look for")
    }

    /// Removes what dead runs of this user have left.
    ///
    /// # Errors
    /// A directory of this user's is open to others, or something cannot be removed.
    pub(crate) fn remove_leftovers(&self) -> anyhow::Result<Vec<Leftover>> {
        self.of_each_parent(remove_abandoned, "remove")
    }

    /// The domain of this user that has this token.
    pub(crate) fn find(&self, token: &str) -> Option<PathBuf> {
        let (standard, taken_by) = self.standard();
        let parents = taken_by.is_none().then_some(standard).into_iter().chain(self.others());
        parents.map(|parent| parent.join(token)).find(|path| path.is_dir())
    }

    fn of_each_parent<E: std::error::Error + Send + Sync + 'static>(
        &self,
        apply: impl Fn(&Path) -> Result<Vec<Leftover>, E>,
        what: &str,
    ) -> anyhow::Result<Vec<Leftover>> {
        let mut leftovers = Vec::new();
        let (standard, taken_by) = self.standard();
        for parent in taken_by.is_none().then_some(standard).into_iter().chain(self.others()) {
            leftovers.extend(apply(&parent).with_context(|| {
                format!("cannot {what} what dead runs have left in {}", parent.display())
            })?);
        }
        Ok(leftovers)
    }

    /// The directories of random name that are this user's alone.
    fn others(&self) -> Vec<PathBuf> {
        let prefix = format!("dmprl-{}-", self.user);
        let private = |metadata: Metadata| {
            metadata.is_dir() && metadata.uid() == self.user && metadata.mode() & 0o7777 == 0o700
        };
        let Ok(entries) = self.base.read_dir() else { return Vec::new() };
        let named = entries.flatten().filter(|entry| {
            entry.file_name().to_str().and_then(|name| name.strip_prefix(&prefix)).is_some_and(
                |rest| rest.len() == RANDOM_DIGITS && rest.bytes().all(|b| b.is_ascii_hexdigit()),
            )
        });
        let mut paths: Vec<_> = named.map(|entry| entry.path()).collect();
        paths.retain(|path| path.symlink_metadata().is_ok_and(private));
        paths.sort();
        paths
    }

    /// Where a new domain goes.
    fn parent(&self) -> anyhow::Result<PathBuf> {
        let (standard, taken_by) = self.standard();
        let Some(other) = taken_by else { return Ok(standard) };
        let parent = match self.others().into_iter().next() {
            Some(parent) => parent,
            None => {
                let random = format!("{:016x}", random_u64()?);
                self.base.join(format!("dmprl-{}-{}", self.user, &random[..RANDOM_DIGITS]))
            }
        };
        say(&format!(
            "warning: {} belongs to user {other}; shared memory is in {} instead",
            standard.display(),
            parent.display()
        ));
        Ok(parent)
    }

    fn create(&self, token: &str) -> anyhow::Result<Domain> {
        self.remove_leftovers()?;
        let parent = self.parent()?;
        Domain::create(&parent, token)
            .with_context(|| format!("cannot make shared memory in {}", parent.display()))
    }
}

/// The name of a run's domain: its number and its supervisor's.
pub(crate) fn token(manifest: &Manifest, supervisor: u32) -> String {
    format!("{}-{supervisor}", manifest.run_id)
}

/// Removes what dead runs have left, then makes a directory for this one.
///
/// # Errors
/// The directory cannot be made, or is open to others.
pub(crate) fn create(token: &str) -> anyhow::Result<Domain> {
    Place::new().create(token)
}

#[cfg(test)]
#[path = "../../../tests/src/skipped.rs"]
mod skipped;

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt, symlink};

    use super::skipped::skipped;
    use super::*;

    fn place() -> (tempfile::TempDir, Place) {
        let base = tempfile::tempdir().unwrap();
        let place = Place { base: base.path().to_owned(), ..Place::new() };
        (base, place)
    }

    /// Whoever may write to shared memory can take a name before its owner does.
    #[test]
    fn a_name_that_another_user_has_taken_blocks_nobody() {
        let (_base, place) = place();
        let (squatted, _) = place.standard();
        std::fs::create_dir(&squatted).unwrap();
        if std::os::unix::fs::chown(&squatted, Some(place.user + 1), None).is_err() {
            let what = "a name in shared memory that another user has taken";
            return skipped("TEST_ROOT_REQUIRED", what, "run the tests as root");
        }
        let first = place.create("first").unwrap();
        let parent = first.path().parent().unwrap().to_owned();
        assert_ne!(parent, squatted);
        assert_eq!(place.others(), std::slice::from_ref(&parent));
        // The next one finds it; nothing is left of it in the end.
        let second = place.create("second").unwrap();
        assert_eq!(second.path().parent(), Some(parent.as_path()));
        assert_eq!(place.leftovers().unwrap(), []);
        drop((first, second));
        assert_eq!(place.others(), Vec::<PathBuf>::new());
        assert!(squatted.is_dir(), "what is another's stays");
    }

    #[test]
    fn a_parent_that_is_a_link_or_open_to_others_is_refused() {
        let (base, place) = place();
        let (standard, taken_by) = place.standard();
        assert_eq!(taken_by, None);
        let elsewhere = base.path().join("elsewhere");
        std::fs::create_dir(&elsewhere).unwrap();
        symlink(&elsewhere, &standard).unwrap();
        let refused = || {
            for error in [
                place.create("run").map(drop).unwrap_err(),
                place.leftovers().map(drop).unwrap_err(),
                place.remove_leftovers().map(drop).unwrap_err(),
            ] {
                let text = format!("{error:#}");
                assert!(text.contains("of this user with mode 0700"), "{text}");
            }
        };
        refused();
        assert_eq!(elsewhere.read_dir().unwrap().count(), 0);
        std::fs::remove_file(&standard).unwrap();
        std::fs::create_dir(&standard).unwrap();
        for mode in [0o755, 0o770, 0o1700] {
            std::fs::set_permissions(&standard, PermissionsExt::from_mode(mode)).unwrap();
            refused();
        }
    }

    #[test]
    fn two_runs_of_one_user_have_a_directory_each() {
        let (_base, place) = place();
        let (one, two) = (place.create("one").unwrap(), place.create("two").unwrap());
        assert_ne!(one.path(), two.path());
        drop(one);
        assert!(two.path().is_dir());
        assert_eq!(place.remove_leftovers().unwrap(), []);
        assert!(two.path().is_dir());
    }
}
