//! Finds and removes the directories of dead runs while holding their locks.

use std::fs::File;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::error::{DomainError, failed};
use super::{
    CONDEMNED, LEARNER_LOCK, LOCK_FILE, UNFINISHED, check_private, condemn, has_marker,
    lock_parent, remove_parent_if_empty, remove_tree,
};

/// Unit of `st_blocks`, independent of the file system [bytes].
const BLOCK_BYTES: u64 = 512;
/// Maximum depth for computing sizes. Domains are three levels deep.
const DEPTH_MAX: usize = 16;

/// Directory of a dead run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Leftover {
    /// The directory.
    pub path: PathBuf,
    /// Disk usage \[bytes\].
    pub bytes: u64,
}

/// A directory that may be removed, and its locks.
struct Abandoned {
    leftover: Leftover,
    /// Whether it is a complete domain, which other processes can still find by its name.
    whole: bool,
    _locks: Vec<File>,
}

/// Lists the domains in `parent` whose processes are dead, without changing anything.
///
/// Skips live domains and directories without dmprl's marker. Returns an empty list if `parent`
/// does not exist.
///
/// # Errors
/// `Untrusted` if `parent` is not private to this user, `Io` if it cannot be read.
pub fn abandoned(parent: &Path) -> Result<Vec<Leftover>, DomainError> {
    let Some(_parent_lock) = private_parent(parent)? else { return Ok(Vec::new()) };
    let mut found = Vec::new();
    for path in entries(parent)? {
        found.extend(take(&path).map(|abandoned| abandoned.leftover));
    }
    Ok(found)
}

/// Removes the domains in `parent` whose processes are dead, and the parent if it is then empty.
///
/// Keeps live domains and directories without dmprl's marker. Does nothing if `parent` does not
/// exist.
///
/// # Errors
/// `Untrusted` if `parent` is not private to this user, `Io` if a domain could not be removed.
pub fn remove_abandoned(parent: &Path) -> Result<Vec<Leftover>, DomainError> {
    let Some(parent_lock) = private_parent(parent)? else { return Ok(Vec::new()) };
    let mut removed = Vec::new();
    for path in entries(parent)? {
        let Some(abandoned) = take(&path) else { continue };
        if !abandoned.whole {
            // Another process may be removing it too, which does no harm.
            remove_tree(&path)?;
        } else if !condemn(&path)? {
            continue;
        }
        removed.push(abandoned.leftover);
    }
    drop(parent_lock);
    if !removed.is_empty() {
        remove_parent_if_empty(parent);
    }
    Ok(removed)
}

/// Locks a parent that is private to this user. Returns `None` if it does not exist.
fn private_parent(parent: &Path) -> Result<Option<File>, DomainError> {
    if parent.symlink_metadata().is_ok_and(|metadata| !metadata.is_dir()) {
        check_private(parent)?;
    }
    let Some(lock) = lock_parent(parent)? else { return Ok(None) };
    check_private(parent)?;
    Ok(Some(lock))
}

fn entries(parent: &Path) -> Result<Vec<PathBuf>, DomainError> {
    let listed = parent.read_dir().map_err(failed("listing", parent))?;
    listed.map(|entry| entry.map(|entry| entry.path()).map_err(failed("listing", parent))).collect()
}

/// Takes a directory's locks if the directory belongs to dmprl and no other process holds them. The
/// caller must hold the parent's lock, which a process that creates a domain holds until it has
/// locked the domain itself.
fn take(path: &Path) -> Option<Abandoned> {
    check_private(path).ok()?;
    let name = path.file_name().unwrap_or_default().as_bytes();
    let whole = !name.starts_with(UNFINISHED.as_bytes()) && !name.starts_with(CONDEMNED.as_bytes());
    let locks = if whole { locks(path)? } else { Vec::new() };
    let leftover = Leftover { path: path.to_owned(), bytes: bytes(path, DEPTH_MAX) };
    Some(Abandoned { leftover, whole, _locks: locks })
}

/// Takes the locks of owner and learner. After the owner is killed, the learner is still alive
/// while it writes its last checkpoint. Skips a domain without the owner's lock file, which is
/// corrupted or being removed.
fn locks(path: &Path) -> Option<Vec<File>> {
    if !has_marker(path) {
        return None;
    }
    let owner = File::open(path.join(LOCK_FILE)).ok()?;
    owner.try_lock().ok()?;
    let mut locks = vec![owner];
    let learner = path.join(LEARNER_LOCK);
    if learner.symlink_metadata().is_ok() {
        let learner = File::open(learner).ok()?;
        learner.try_lock().ok()?;
        locks.push(learner);
    }
    Some(locks)
}

/// Returns the disk usage of a directory. Entries that cannot be read or are gone count as 0.
fn bytes(directory: &Path, depth: usize) -> u64 {
    let Ok(entries) = directory.read_dir() else { return 0 };
    let of = |entry: std::fs::DirEntry| match entry.metadata() {
        Ok(metadata) if metadata.is_dir() && depth > 0 => bytes(&entry.path(), depth - 1),
        Ok(metadata) => metadata.blocks().saturating_mul(BLOCK_BYTES),
        Err(_) => 0,
    };
    entries.flatten().map(of).sum()
}
