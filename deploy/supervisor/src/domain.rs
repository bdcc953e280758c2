//! Creates, finds and removes the run's private shared-memory directory, its domain.
//!
//! A user's domains are in `dmprl-<uid>`. Shared memory is writable for all users, so another user
//! can take that name first. The domains are then in `dmprl-<uid>-<random>`, whose name is hard to
//! guess.

use std::fs::Metadata;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dmprl_run::{Manifest, random_u64};
use dmprl_shared::transport::shared_memory::{Domain, Leftover, abandoned, remove_abandoned};
use tracing::warn;

/// Number of random digits in a name. Paths of domains must stay short.
const RANDOM_DIGITS: usize = 8;

/// The directories of a user's domains in a file system for shared memory.
#[derive(Debug, Clone)]
pub struct Place {
    base: PathBuf,
    user: u32,
}

impl Place {
    /// Returns the place for this user, in a memory-backed file system if there is one.
    pub fn of_this_user() -> Self {
        let shared_memory = Path::new("/dev/shm");
        let base =
            if shared_memory.is_dir() { shared_memory.to_owned() } else { std::env::temp_dir() };
        Self { base, user: rustix::process::geteuid().as_raw() }
    }

    /// The file system's directory.
    pub fn base(&self) -> &Path {
        &self.base
    }

    /// Returns the standard directory of this user's domains, and the id of its owner if that is
    /// another user.
    pub fn standard(&self) -> (PathBuf, Option<u32>) {
        let path = self.base.join(format!("dmprl-{}", self.user));
        let owner = path.symlink_metadata().ok().map(|metadata| metadata.uid());
        (path, owner.filter(|&owner| owner != self.user))
    }

    /// Lists the leftovers of this user's dead runs. Changes nothing.
    ///
    /// # Errors
    /// A directory of this user is open to others, or cannot be read.
    pub fn leftovers(&self) -> anyhow::Result<Vec<Leftover>> {
        self.of_each_parent(abandoned, "look for")
    }

    /// Removes the leftovers of this user's dead runs.
    ///
    /// # Errors
    /// A directory of this user is open to others, or a leftover cannot be removed.
    pub fn remove_leftovers(&self) -> anyhow::Result<Vec<Leftover>> {
        self.of_each_parent(remove_abandoned, "remove")
    }

    /// Finds this user's domain with this token.
    pub fn find(&self, token: &str) -> Option<PathBuf> {
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
                format!("cannot {what} leftovers of dead runs in {}", parent.display())
            })?);
        }
        Ok(leftovers)
    }

    /// Lists this user's private directories with random names.
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

    /// Chooses the directory of a new domain.
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
        warn!(
            "{} belongs to user {other}; shared memory is in {} instead",
            standard.display(),
            parent.display()
        );
        Ok(parent)
    }

    fn create(&self, token: &str) -> anyhow::Result<Domain> {
        self.remove_leftovers()?;
        let parent = self.parent()?;
        Domain::create(&parent, token)
            .with_context(|| format!("cannot create shared memory in {}", parent.display()))
    }
}

/// Returns the name of a run's domain: the run's id and its supervisor's process id.
pub fn token(manifest: &Manifest, supervisor: u32) -> String {
    format!("{}-{supervisor}", manifest.run_id)
}

/// Removes leftovers of dead runs, then creates the directory of this one.
///
/// # Errors
/// The directory cannot be created, or is open to others.
pub fn create(token: &str) -> anyhow::Result<Domain> {
    Place::of_this_user().create(token)
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
        let place = Place { base: base.path().to_owned(), ..Place::of_this_user() };
        (base, place)
    }

    #[test]
    fn a_name_taken_by_another_user_is_avoided() {
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
        // The next domain uses the same directory, which is removed with the last.
        let second = place.create("second").unwrap();
        assert_eq!(second.path().parent(), Some(parent.as_path()));
        assert_eq!(place.leftovers().unwrap(), []);
        drop((first, second));
        assert_eq!(place.others(), Vec::<PathBuf>::new());
        assert!(squatted.is_dir(), "another user's directory stays");
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
    fn runs_of_a_user_have_separate_directories() {
        let (_base, place) = place();
        let (one, two) = (place.create("one").unwrap(), place.create("two").unwrap());
        assert_ne!(one.path(), two.path());
        drop(one);
        assert!(two.path().is_dir());
        assert_eq!(place.remove_leftovers().unwrap(), []);
        assert!(two.path().is_dir());
    }
}
