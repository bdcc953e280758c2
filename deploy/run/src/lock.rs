//! An exclusive `flock` on a run's file `lock`, so that only one supervisor trains the run.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};

use tracing::info;

/// Interval at which a waiting process tries again.
const POLL: Duration = Duration::from_millis(50);

/// The lock of a run, held until this process and every child that inherited it have ended.
///
/// Children inherit the descriptor on purpose: if the supervisor is killed, the learner still
/// writes a last checkpoint, and `dmprl resume` must not start before that.
#[derive(Debug)]
pub struct RunLock {
    _file: File,
}

impl RunLock {
    /// Locks the directory `run`. If its supervisor has died, waits at most `wait` for the
    /// supervisor's children to end.
    ///
    /// # Errors
    /// The supervisor is alive, its children outlive `wait`, or an I/O error.
    pub fn take(run: &Path, wait: Duration) -> anyhow::Result<Self> {
        let path = run.join("lock");
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            // Any user who can open the file could lock it and keep the owner from resuming.
            .mode(0o600)
            .open(&path)
            .with_context(|| format!("cannot open {}", path.display()))?;
        let deadline = Instant::now() + wait;
        let mut logged = false;
        loop {
            match file.try_lock() {
                Ok(()) => break,
                Err(TryLockError::WouldBlock) => {
                    let holder = holder(&mut file);
                    if is_other_live_process(&holder) || Instant::now() >= deadline {
                        bail!(
                            "{} is being trained by process {holder}; stop it, or wait until it \
                             ends",
                            run.display()
                        );
                    }
                    if !logged {
                        logged = true;
                        info!(
                            "process {holder} has died; waiting up to {wait:?} for its learner's \
                             last checkpoint"
                        );
                    }
                    thread::sleep(POLL);
                }
                Err(TryLockError::Error(error)) => {
                    return Err(error).with_context(|| format!("cannot lock {}", path.display()));
                }
            }
        }
        file.set_len(0)
            .and_then(|()| file.rewind())
            .and_then(|()| writeln!(file, "{}", std::process::id()))
            .with_context(|| format!("cannot write {}", path.display()))?;
        rustix::io::fcntl_setfd(&file, rustix::io::FdFlags::empty())
            .with_context(|| format!("cannot make {} inheritable", path.display()))?;
        Ok(Self { _file: file })
    }
}

/// Returns the process id of the supervisor that took the lock last.
pub(crate) fn last_holder(run: &Path) -> Option<u32> {
    holder(&mut File::open(run.join("lock")).ok()?).parse().ok()
}

/// Returns true if a process is a supervisor; its id may have been reused. Reads `/proc` instead of
/// trying the lock, because even a short hold of the lock could make a concurrent resume fail.
pub(crate) fn is_trainer(id: u32) -> bool {
    let line = std::fs::read(format!("/proc/{id}/cmdline")).unwrap_or_default();
    let command = line.split(|&byte| byte == 0).nth(1).unwrap_or_default();
    [b"train".as_slice(), b"resume", b"chaos"].contains(&command)
}

/// Returns the process id that the lock file contains; empty if the file cannot be read.
fn holder(file: &mut File) -> String {
    let mut text = String::new();
    let _ = file.rewind().and_then(|()| file.read_to_string(&mut text));
    text.trim().to_owned()
}

/// Returns true if `holder` is alive and not this process, which may have held the lock before.
fn is_other_live_process(holder: &str) -> bool {
    let other = holder.parse().is_ok_and(|id: u32| id != std::process::id());
    // A zombie has no command line.
    let line = std::fs::read(Path::new("/proc").join(holder).join("cmdline"));
    other && line.is_ok_and(|line| !line.is_empty())
}
