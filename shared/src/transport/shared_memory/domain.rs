//! The run's private directory for shared memory, with its permissions, locks and removal.
//!
//! ```text
//! /dev/shm/dmprl-<uid>/     0700, the parent: all runs of this user
//!   <token>/                0700, one run
//!     domain                marks a directory that dmprl may remove
//!     owner.lock            locked while the owner is alive
//!     …                     see `generation`
//! ```
//! The kernel releases a lock when its process ends for any reason, so a directory whose lock is
//! free is abandoned. Directories are created and removed while the parent is locked, so that a
//! directory between its `mkdir` and its lock never looks abandoned.

mod error;
mod leftovers;

use std::fs::{DirBuilder, File, OpenOptions, TryLockError};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{CWD, OFlags, RenameFlags, renameat_with, statvfs};

pub use error::DomainError;
use error::{ROOT_BYTES_MAX, TOKEN_BYTES_MAX, failed};
pub use leftovers::{Leftover, abandoned, remove_abandoned};

use super::generation::DIRECTORY_BYTES;
use super::service::PREFIX;

const MARKER_FILE: &str = "domain";
const MARKER_TEXT: &str = "dmprl shared-memory domain, version 1\n";
const LOCK_FILE: &str = "owner.lock";
/// The learner holds this lock while it is alive.
pub(super) const LEARNER_LOCK: &str = "learner.lock";
/// Prefix of directories that are being created. They are renamed when they are complete.
const UNFINISHED: &str = ".dmprl-unfinished-";
/// Prefix of directories that are being removed. They are renamed first, so that no process can
/// join them.
const CONDEMNED: &str = ".dmprl-condemned-";
/// Attempts to take the parent's lock, which other processes hold only for milliseconds.
const PARENT_LOCK_ATTEMPTS: usize = 500;
const PARENT_LOCK_PAUSE: Duration = Duration::from_millis(10);

/// The run's shared-memory directory. Its creator owns it and removes it on drop.
#[derive(Debug)]
pub struct Domain {
    path: PathBuf,
    /// The owner's lock; `None` in processes that only opened the domain.
    owner: Option<File>,
}

impl Domain {
    /// Creates the directory `token` in `parent`, and `parent` if it does not exist.
    ///
    /// `token` should be random to avoid collisions between runs.
    ///
    /// # Errors
    /// `Token` or `TooLong` for invalid names, `Untrusted` if `parent` is not private to this user,
    /// `Io` (`AlreadyExists`) if the domain exists.
    pub fn create(parent: &Path, token: &str) -> Result<Self, DomainError> {
        check_token(token)?;
        let path = parent.join(token);
        let bytes = path.as_os_str().len() + DIRECTORY_BYTES + "/".len() + PREFIX.len();
        if bytes > ROOT_BYTES_MAX {
            return Err(DomainError::TooLong { path, got: bytes });
        }
        let _parent_lock = make_and_lock_parent(parent)?;
        let unfinished = parent.join(format!("{UNFINISHED}{token}"));
        remove_tree(&unfinished)?;
        private_directory().create(&unfinished).map_err(failed("creating", &unfinished))?;
        let owner = private_file(&unfinished.join(LOCK_FILE))?;
        try_lock(&owner, &path)?;
        let marker = unfinished.join(MARKER_FILE);
        private_file(&marker)?
            .write_all(MARKER_TEXT.as_bytes())
            .map_err(failed("writing", &marker))?;
        // A plain rename would silently replace an empty directory.
        renameat_with(CWD, &unfinished, CWD, &path, RenameFlags::NOREPLACE)
            .map_err(|errno| failed("creating", &path)(errno.into()))?;
        Ok(Self { path, owner: Some(owner) })
    }

    /// Opens a domain that another process owns.
    ///
    /// # Errors
    /// `Untrusted` if it is not private to this user or not a domain, `Io` if it does not exist.
    pub fn open(path: &Path) -> Result<Self, DomainError> {
        check_private(path)?;
        if !has_marker(path) {
            return Err(DomainError::Untrusted {
                path: path.to_owned(),
                expected: "a directory with dmprl's marker",
                got: "none or another marker".to_owned(),
            });
        }
        Ok(Self { path: path.to_owned(), owner: None })
    }

    /// Path of the directory.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Checks that at least `needed_bytes` of shared memory are free.
    ///
    /// Creating a file in shared memory does not reserve its space. If the file system is full when
    /// a process first writes to a page, the kernel kills the process; this check prevents that.
    ///
    /// # Errors
    /// `Space` if too little is free; `Io` if the free space cannot be determined.
    pub fn check_space(&self, needed_bytes: u64) -> Result<(), DomainError> {
        let file_system = statvfs(&self.path)
            .map_err(|errno| failed("reading the free space of", &self.path)(errno.into()))?;
        let available = file_system.f_bavail.saturating_mul(file_system.f_frsize);
        if available < needed_bytes {
            let path = self.path.clone();
            return Err(DomainError::Space { path, needed: needed_bytes, available });
        }
        Ok(())
    }

    /// Takes the lock `name` in this domain. The lock is held while the returned file is open.
    pub(super) fn lock(&self, name: &str) -> Result<File, DomainError> {
        let path = self.path.join(name);
        let file = OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(&path)
            .map_err(failed("opening", &path))?;
        try_lock(&file, &path)?;
        Ok(file)
    }
}

impl Drop for Domain {
    fn drop(&mut self) {
        if self.owner.is_some() && has_marker(&self.path) {
            // Ignores errors: `remove_abandoned` removes the rest later.
            let _ = condemn(&self.path);
            if let Some(parent) = self.path.parent() {
                remove_parent_if_empty(parent);
            }
        }
    }
}

/// Renames the domain, so that no process can join it, and removes it. Returns false if it did not
/// exist.
fn condemn(path: &Path) -> Result<bool, DomainError> {
    let mut name = std::ffi::OsString::from(CONDEMNED);
    name.push(path.file_name().unwrap_or_default());
    let condemned = path.with_file_name(name);
    match std::fs::rename(path, &condemned) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(false),
        renamed => renamed.map_err(failed("renaming", path))?,
    }
    remove_tree(&condemned).map(|()| true)
}

/// Removes a directory if it exists. Symbolic links below it are removed, not followed.
fn remove_tree(path: &Path) -> Result<(), DomainError> {
    match std::fs::remove_dir_all(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(failed("removing", path)(error)),
        _ => Ok(()),
    }
}

fn check_token(token: &str) -> Result<(), DomainError> {
    let is_valid = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'-' || byte == b'_';
    if (1..=TOKEN_BYTES_MAX).contains(&token.len()) && token.bytes().all(is_valid) {
        return Ok(());
    }
    Err(DomainError::Token { got: token.to_owned() })
}

fn private_directory() -> DirBuilder {
    let mut builder = DirBuilder::new();
    builder.mode(0o700);
    builder
}

fn private_file(path: &Path) -> Result<File, DomainError> {
    OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(path)
        .map_err(failed("creating", path))
}

/// Creates and locks the parent. Another process may remove it in between, together with the last
/// domain in it; it is then created again.
fn make_and_lock_parent(parent: &Path) -> Result<File, DomainError> {
    for _ in 0..PARENT_LOCK_ATTEMPTS {
        match private_directory().create(parent) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => {
                return Err(failed("creating", parent)(error));
            }
            _ => {}
        }
        if let Some(lock) = lock_parent(parent)? {
            check_private(parent)?;
            return Ok(lock);
        }
    }
    Err(DomainError::Locked { path: parent.to_owned() })
}

/// Removes the parent if it is empty and can be locked. Otherwise it stays, which does no harm.
fn remove_parent_if_empty(parent: &Path) {
    if let Ok(Some(_lock)) = lock_parent(parent) {
        let _ = std::fs::remove_dir(parent);
    }
}

fn check_private(path: &Path) -> Result<(), DomainError> {
    let metadata = path.symlink_metadata().map_err(failed("inspecting", path))?;
    let user = rustix::process::geteuid().as_raw();
    let mode = metadata.mode() & 0o7777;
    if path.is_absolute() && metadata.is_dir() && metadata.uid() == user && mode == 0o700 {
        return Ok(());
    }
    let kind = if metadata.is_dir() { "directory" } else { "file or symbolic link" };
    Err(DomainError::Untrusted {
        path: path.to_owned(),
        expected: "the absolute path of a directory of this user with mode 0700",
        got: format!("{kind} of user {} with mode {mode:04o}", metadata.uid()),
    })
}

fn has_marker(path: &Path) -> bool {
    std::fs::read(path.join(MARKER_FILE)).is_ok_and(|text| text == MARKER_TEXT.as_bytes())
}

fn try_lock(file: &File, path: &Path) -> Result<(), DomainError> {
    match file.try_lock() {
        Ok(()) => Ok(()),
        Err(TryLockError::WouldBlock) => Err(DomainError::Locked { path: path.to_owned() }),
        Err(TryLockError::Error(cause)) => Err(failed("locking", path)(cause)),
    }
}

/// Locks the parent directory itself, so that no lock file can be left behind. Returns `None` if
/// the directory does not exist or was removed while waiting for its lock.
fn lock_parent(parent: &Path) -> Result<Option<File>, DomainError> {
    let opened = OpenOptions::new()
        .read(true)
        .custom_flags((OFlags::DIRECTORY | OFlags::NOFOLLOW).bits().cast_signed())
        .open(parent);
    let directory = match opened {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        opened => opened.map_err(failed("opening", parent))?,
    };
    for _ in 0..PARENT_LOCK_ATTEMPTS {
        match try_lock(&directory, parent) {
            Err(DomainError::Locked { .. }) => std::thread::sleep(PARENT_LOCK_PAUSE),
            Err(error) => return Err(error),
            Ok(()) => {
                let locked = directory.metadata().map_err(failed("inspecting", parent))?;
                let same = |there: std::fs::Metadata| {
                    (there.dev(), there.ino()) == (locked.dev(), locked.ino())
                };
                return Ok(parent.symlink_metadata().is_ok_and(same).then_some(directory));
            }
        }
    }
    Err(DomainError::Locked { path: parent.to_owned() })
}
