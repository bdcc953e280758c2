//! One run, one trainer: an exclusive `flock` on the file `lock`.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};

use tracing::info;

/// How often a waiting process looks again.
const POLL: Duration = Duration::from_millis(50);

/// Holds the run until it and every child that inherited it are gone.
///
/// Children inherit the descriptor on purpose: when the supervisor is killed, the learner still
/// writes a last checkpoint, and a `dmprl resume` must not start beside it.
#[derive(Debug)]
pub struct RunLock {
    _file: File,
}

impl RunLock {
    /// Takes the lock of the directory `run`; waits at most `wait` for another holder.
    ///
    /// # Errors
    /// Another process holds it beyond `wait`, or the file cannot be written.
    pub fn take(run: &Path, wait: Duration) -> anyhow::Result<Self> {
        let path = run.join("lock");
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            // Who can open it can lock it, and so keep the owner from resuming.
            .mode(0o600)
            .open(&path)
            .with_context(|| format!("cannot open {}", path.display()))?;
        let deadline = Instant::now() + wait;
        let mut told = false;
        loop {
            match file.try_lock() {
                Ok(()) => break,
                Err(TryLockError::WouldBlock) => {
                    let holder = holder(&mut file);
                    if lives(&holder) || Instant::now() >= deadline {
                        bail!(
                            "{} is being trained by process {holder}; stop it first or wait \
                             for its end",
                            run.display()
                        );
                    }
                    if !told {
                        told = true;
                        info!(
                            "process {holder} has died; waiting up to {wait:?} for the last \
                             checkpoint of its learner"
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
            .with_context(|| format!("cannot pass {} on to children", path.display()))?;
        Ok(Self { _file: file })
    }
}

/// The supervisor that took the lock last, by its process's number.
pub(crate) fn last_holder(run: &Path) -> Option<u32> {
    holder(&mut File::open(run.join("lock")).ok()?).parse().ok()
}

/// Whether a process is a supervisor: its number may be another's by now. Asked of the system and
/// not of the lock, which nobody else may hold for a moment while a resume asks for it.
pub(crate) fn is_trainer(id: u32) -> bool {
    let line = std::fs::read(format!("/proc/{id}/cmdline")).unwrap_or_default();
    let command = line.split(|&byte| byte == 0).nth(1).unwrap_or_default();
    [b"train".as_slice(), b"resume", b"chaos"].contains(&command)
}

/// The supervisor that took the lock last. An unreadable file is as good as an empty one.
fn holder(file: &mut File) -> String {
    let mut text = String::new();
    let _ = file.rewind().and_then(|()| file.read_to_string(&mut text));
    text.trim().to_owned()
}

/// Whether waiting for `holder`'s children is in vain, because it lives itself. This process's own
/// number is there when it held the lock before.
fn lives(holder: &str) -> bool {
    let other = holder.parse().is_ok_and(|id: u32| id != std::process::id());
    // A zombie has no command line.
    let line = std::fs::read(Path::new("/proc").join(holder).join("cmdline"));
    other && line.is_ok_and(|line| !line.is_empty())
}
