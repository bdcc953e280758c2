//! One run, one trainer: an exclusive `flock` on the file `lock`.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};

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
    pub(super) fn take(run: &Path, wait: Duration) -> anyhow::Result<Self> {
        let path = run.join("lock");
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&path)
            .with_context(|| format!("cannot open {}", path.display()))?;
        let deadline = Instant::now() + wait;
        loop {
            match file.try_lock() {
                Ok(()) => break,
                Err(TryLockError::WouldBlock) if Instant::now() < deadline => thread::sleep(POLL),
                Err(TryLockError::WouldBlock) => {
                    let mut holder = String::new();
                    // Only for the message: an unreadable file is as good as an empty one.
                    let _ = file.read_to_string(&mut holder);
                    bail!(
                        "run {} is being trained by process {}; stop it first or wait for its end",
                        run.display(),
                        holder.trim()
                    );
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
