//! What the lock needs from the machine: file locks, processes and a clock. Tests replace it.

use std::fs::{self, DirEntry, File, TryLockError};
use std::io::{self, ErrorKind};
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use rustix::io::Errno;

use super::holder::Holder;

/// Result of an attempt to lock a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FileLock {
    /// It is locked; on some network file systems only for the processes of this host.
    Taken,
    /// Another process has it.
    Busy,
    /// The file system has no locks.
    Unsupported,
}

/// The machine of a process that takes a lock.
pub(super) trait Machine {
    /// Describes this process.
    fn this(&self) -> Holder;

    /// Returns whether a process is alive, or `None` if it is or may be on another machine.
    fn is_alive(&self, holder: &Holder) -> Option<bool>;

    /// Tries to lock a file; a lock that this process has already counts as taken.
    fn try_lock(&self, file: &File) -> io::Result<FileLock>;

    /// Returns whether another process of this user and machine has the file open.
    fn is_open_elsewhere(&self, path: &Path) -> bool;

    /// Time since some moment, monotonic.
    fn now(&self) -> Duration;

    /// Waits.
    fn sleep(&self, duration: Duration);
}

/// The machine of this process.
#[derive(Debug)]
pub(super) struct ThisMachine {
    started: Instant,
}

impl ThisMachine {
    pub(super) fn new() -> Self {
        Self { started: Instant::now() }
    }
}

impl Machine for ThisMachine {
    fn this(&self) -> Holder {
        Holder::this()
    }

    fn is_alive(&self, holder: &Holder) -> Option<bool> {
        holder.is_on_this_machine().then(|| holder.is_running())
    }

    fn try_lock(&self, file: &File) -> io::Result<FileLock> {
        match file.try_lock() {
            Ok(()) => Ok(FileLock::Taken),
            Err(TryLockError::WouldBlock) => Ok(FileLock::Busy),
            Err(TryLockError::Error(error)) if is_unsupported(&error) => Ok(FileLock::Unsupported),
            Err(TryLockError::Error(error)) => Err(error),
        }
    }

    fn is_open_elsewhere(&self, path: &Path) -> bool {
        let is_other = |process: &DirEntry| {
            // Not `self`, either.
            let id = process.file_name().to_str().and_then(|name| name.parse::<u32>().ok());
            id.is_some_and(|id| id != std::process::id())
        };
        let processes = fs::read_dir("/proc").into_iter().flatten().flatten();
        processes.filter(is_other).any(|process| {
            // Processes of other users have no readable descriptors.
            let descriptors = fs::read_dir(process.path().join("fd")).into_iter().flatten();
            descriptors.flatten().any(|it| fs::read_link(it.path()).is_ok_and(|it| it == path))
        })
    }

    fn now(&self) -> Duration {
        self.started.elapsed()
    }

    fn sleep(&self, duration: Duration) {
        thread::sleep(duration);
    }
}

fn is_unsupported(error: &io::Error) -> bool {
    let codes = [Errno::NOLCK, Errno::NOTSUP, Errno::OPNOTSUPP, Errno::NOSYS];
    error.kind() == ErrorKind::Unsupported
        || codes.iter().any(|code| error.raw_os_error() == Some(code.raw_os_error()))
}
