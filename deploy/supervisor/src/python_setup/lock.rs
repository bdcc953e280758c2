//! The lock that serialises changes of an environment.

use std::{
    fs::{File, TryLockError},
    path::Path,
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, Result, bail};

/// Maximum wait for the lock, longer than an installation over a slow connection takes.
const WAIT_MAX: Duration = Duration::from_secs(30 * 60);
/// Interval between attempts to take the lock, each with a progress line.
const INTERVAL: Duration = Duration::from_millis(500);

/// Waits for a concurrent start that creates the same environment. The system releases the lock
/// with its last holder, so a crash leaves no stale lock.
pub(super) fn locked(path: &Path, progress: &dyn Fn(&str)) -> Result<File> {
    let lock = File::options()
        .create(true)
        .truncate(false)
        .read(true)
        .write(true)
        .open(path)
        .with_context(|| format!("cannot write {}", path.display()))?;
    let started = Instant::now();
    // `File::lock` has no time limit and reports no progress.
    while started.elapsed() < WAIT_MAX {
        match lock.try_lock() {
            Ok(()) => return Ok(lock),
            Err(TryLockError::WouldBlock) => {}
            Err(TryLockError::Error(error)) => {
                return Err(error).with_context(|| format!("cannot lock {}", path.display()));
            }
        }
        let seconds = started.elapsed().as_secs();
        progress(&format!("python environment: waiting for another start ({seconds} s)"));
        thread::sleep(INTERVAL);
    }
    bail!(
        "another process has been creating {} for {} minutes; stop it, or its pip, and retry",
        path.with_extension("").display(),
        WAIT_MAX.as_secs() / 60
    )
}
