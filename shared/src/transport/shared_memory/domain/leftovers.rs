//! What dead runs have left: finding it, and removing it while holding its locks.

use std::fs::File;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::super::LEARNER_LOCK;
use super::{
    CONDEMNED, DomainError, LOCK_FILE, UNFINISHED, check_private, condemn, failed, has_marker,
    lock_parent, remove_parent_if_empty, remove_tree,
};

/// A file system counts in blocks of this size, whatever its own [bytes].
const BLOCK_BYTES: u64 = 512;
/// Folders in each other that a size is counted of; ours are three deep.
const DEPTH_MAX: usize = 16;

/// A directory that a dead run has left.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Leftover {
    /// The directory.
    pub path: PathBuf,
    /// What it takes \[bytes\].
    pub bytes: u64,
}

/// A directory that may be removed, and the locks that keep it so.
struct Abandoned {
    leftover: Leftover,
    /// Whether it is a whole domain, which others may still find under its name.
    whole: bool,
    _locks: Vec<File>,
}

/// The domains in `parent` whose processes are dead. Changes nothing.
///
/// Live domains and directories without our marker are left out. A missing `parent` has none.
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

/// Removes the domains in `parent` whose processes are dead, and the parent with the last one.
///
/// Live domains and directories without our marker stay. A missing `parent` has none.
///
/// # Errors
/// `Untrusted` if `parent` is not private to this user, `Io` if something could not be removed.
pub fn remove_abandoned(parent: &Path) -> Result<Vec<Leftover>, DomainError> {
    let Some(parent_lock) = private_parent(parent)? else { return Ok(Vec::new()) };
    let mut removed = Vec::new();
    for path in entries(parent)? {
        let Some(abandoned) = take(&path) else { continue };
        if !abandoned.whole {
            // Who removes one does not mind help.
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

/// The lock of a parent that is private to this user; `None` if there is no parent.
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

/// Takes a directory's locks, if it is ours and nobody else has them. For the holder of the
/// parent's lock: who makes a domain holds it until the domain's own is taken.
fn take(path: &Path) -> Option<Abandoned> {
    check_private(path).ok()?;
    let name = path.file_name().unwrap_or_default().as_bytes();
    let whole = !name.starts_with(UNFINISHED.as_bytes()) && !name.starts_with(CONDEMNED.as_bytes());
    let locks = if whole { locks(path)? } else { Vec::new() };
    let leftover = Leftover { path: path.to_owned(), bytes: bytes(path, DEPTH_MAX) };
    Some(Abandoned { leftover, whole, _locks: locks })
}

/// The locks of owner and learner: a learner outlives a killed owner for as long as it writes its
/// last checkpoint. A domain without its owner's lock file is damaged or just being removed: not
/// ours to judge.
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

/// What a directory takes. What cannot be looked at, or is gone by now, counts nothing.
fn bytes(directory: &Path, depth: usize) -> u64 {
    let Ok(entries) = directory.read_dir() else { return 0 };
    let of = |entry: std::fs::DirEntry| match entry.metadata() {
        Ok(metadata) if metadata.is_dir() && depth > 0 => bytes(&entry.path(), depth - 1),
        Ok(metadata) => metadata.blocks().saturating_mul(BLOCK_BYTES),
        Err(_) => 0,
    };
    entries.flatten().map(of).sum()
}
