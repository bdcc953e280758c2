//! The lock of a run: only one supervisor trains it, also if its directory is shared by hosts.
//!
//! Two mechanisms, because neither suffices alone:
//!
//! - An exclusive `flock` on the file `lock`. Children inherit it, and the kernel releases it with
//!   the last of them. On network file systems it may hold only within one host, or be absent.
//! - A lease, the file `lease.N` with the highest N (see `lease.rs`), which the supervisor renews
//!   while it lives.
//!
//! A holder on this machine is alive or dead according to `/proc`. A holder on another one counts
//! as dead once its lease has not changed for [`LEASE_TIMEOUT`] on this process's own clock.

mod holder;
mod lease;
mod machine;
mod renewal;
#[cfg(test)]
mod tests;

use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, ensure};
use tracing::info;

pub use self::holder::Holder;
use self::lease::{FoundLease, Lease, TIMEOUT};
use self::machine::{FileLock, Machine, ThisMachine};
pub use self::renewal::LockWatch;
use self::renewal::Renewal;

/// Time without a renewal of its lease after which a holder on another machine counts as dead.
pub const LEASE_TIMEOUT: Duration = TIMEOUT;
/// Interval at which a waiting process tries again.
const POLL: Duration = Duration::from_millis(50);
/// The same while it watches a lease, which may be on a server.
const POLL_LEASE: Duration = Duration::from_secs(1);
/// Attempts to create a lease that other processes create at the same time.
const CLAIMS_MAX: u32 = 100;

/// The lock of a run. The `flock` is held until this process and every child that inherited it have
/// ended; the lease is released on drop.
///
/// Children inherit the descriptor on purpose: if the supervisor is killed, the learner still
/// writes a last checkpoint, and `dmprl resume` must not start before that.
#[derive(Debug)]
pub struct RunLock {
    // Dropped first: whoever gets the `flock` then finds a released lease.
    renewal: Renewal,
    _file: File,
}

impl RunLock {
    /// Locks the directory `run`. If its supervisor has died, waits at most `wait` for the
    /// supervisor's children to end. If the supervisor is on another machine, first watches its
    /// lease, for at most [`LEASE_TIMEOUT`].
    ///
    /// # Errors
    /// The supervisor is alive, its children outlive `wait`, or an I/O error.
    pub fn take(run: &Path, wait: Duration) -> anyhow::Result<Self> {
        let Taken { lease, file } = take(run, wait, &ThisMachine::new())?;
        rustix::io::fcntl_setfd(&file, rustix::io::FdFlags::empty())
            .with_context(|| format!("cannot make {} inheritable", lock_path(run).display()))?;
        Ok(Self { renewal: Renewal::start(lease)?, _file: file })
    }

    /// Returns a view that tells whether another process has taken the run over.
    #[must_use]
    pub fn watch(&self) -> LockWatch {
        self.renewal.watch()
    }
}

/// Returns the supervisor that took the lock last.
pub(crate) fn last_holder(run: &Path) -> Option<Holder> {
    read_holder(&mut File::open(lock_path(run)).ok()?)
}

/// A lock that was just taken.
#[derive(Debug)]
struct Taken {
    lease: Lease,
    file: File,
}

/// What an attempt found.
enum Finding {
    /// The lock can be taken.
    Free,
    /// The holder is alive.
    Held(Option<Holder>),
    /// The holder has died, and its children have not ended.
    Ending(Option<Holder>),
    /// The holder is on another machine, and its lease may still be renewed.
    Unknown(Option<Holder>),
}

fn take(run: &Path, wait: Duration, machine: &dyn Machine) -> anyhow::Result<Taken> {
    let path = lock_path(run);
    let mut file = OpenOptions::new()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        // Any user who can open the file could lock it and keep the owner from resuming.
        .mode(0o600)
        .open(&path)
        .with_context(|| format!("cannot open {}", path.display()))?;
    let mut search = Search { run, machine, watched: None, ending_since: None, announced: false };
    let mut claims = 0;
    let lease = loop {
        let lock =
            machine.try_lock(&file).with_context(|| format!("cannot lock {}", path.display()))?;
        let failed = || format!("cannot use the lease of {}", run.display());
        let newest = lease::newest(run).with_context(failed)?;
        let pause = match search.look(lock, newest.as_ref(), read_holder(&mut file)) {
            Finding::Free => {
                let number = newest.map_or(0, |lease| lease.number).saturating_add(1);
                if let Some(lease) =
                    Lease::claim(run, number, machine.this()).with_context(failed)?
                {
                    break lease;
                }
                claims += 1;
                ensure!(claims < CLAIMS_MAX, "other processes lock {} too", run.display());
                POLL
            }
            Finding::Held(holder) => return Err(refused(run, holder.as_ref())),
            Finding::Ending(holder) => search.wait_for_children(holder.as_ref(), wait)?,
            Finding::Unknown(holder) => search.watch_lease(holder.as_ref()),
        };
        machine.sleep(pause);
    };
    write_holder(&mut file, &machine.this())
        .with_context(|| format!("cannot write {}", path.display()))?;
    Ok(Taken { lease, file })
}

/// An attempt to take a lock, over time.
struct Search<'a> {
    run: &'a Path,
    machine: &'a dyn Machine,
    /// Lease of a holder on another machine.
    watched: Option<WatchedLease>,
    /// Time at which the holder was found to be dead, while its children were not.
    ending_since: Option<Duration>,
    announced: bool,
}

/// A lease, and since when it has been the same.
struct WatchedLease {
    found: FoundLease,
    since: Duration,
}

impl Search<'_> {
    /// Judges the state of the lock. `locked_by` is the content of the lock file.
    fn look(
        &mut self,
        lock: FileLock,
        newest: Option<&FoundLease>,
        locked_by: Option<Holder>,
    ) -> Finding {
        let Some(lease) = newest.filter(|lease| !lease.released) else {
            return without_lease(lock, locked_by);
        };
        let holder = lease.holder.clone();
        match holder.as_ref().and_then(|holder| self.machine.is_alive(holder)) {
            Some(true) => Finding::Held(holder),
            Some(false) if self.children_live(lock) => Finding::Ending(holder),
            Some(false) => Finding::Free,
            None => match self.unchanged_for(lease) {
                None => Finding::Held(holder),
                Some(unchanged) if unchanged < TIMEOUT => Finding::Unknown(holder),
                // Other hosts may see the `flock` of its children.
                Some(_) if lock == FileLock::Busy => Finding::Ending(holder),
                Some(_) => Finding::Free,
            },
        }
    }

    fn children_live(&self, lock: FileLock) -> bool {
        match lock {
            FileLock::Taken => false,
            FileLock::Busy => true,
            FileLock::Unsupported => self.machine.is_open_elsewhere(&lock_path(self.run)),
        }
    }

    /// Returns for how long a lease has been the same, or `None` if it has changed.
    fn unchanged_for(&mut self, lease: &FoundLease) -> Option<Duration> {
        let now = self.machine.now();
        let new = || WatchedLease { found: lease.clone(), since: now };
        let watched = self.watched.get_or_insert_with(new);
        (watched.found == *lease).then(|| now.saturating_sub(watched.since))
    }

    /// Returns the time until the next attempt; fails after `wait`.
    fn wait_for_children(
        &mut self,
        holder: Option<&Holder>,
        wait: Duration,
    ) -> anyhow::Result<Duration> {
        let now = self.machine.now();
        let since = *self.ending_since.get_or_insert(now);
        if now.saturating_sub(since) >= wait {
            return Err(refused(self.run, holder));
        }
        if since == now {
            info!(
                "{} has died; waiting up to {wait:?} for its learner's last checkpoint",
                named(holder)
            );
        }
        Ok(POLL)
    }

    /// Returns the time until the next attempt.
    fn watch_lease(&mut self, holder: Option<&Holder>) -> Duration {
        if !self.announced {
            self.announced = true;
            info!(
                "{} was the last to train {}; watching its lease for {TIMEOUT:?}, and taking the \
                 run over unless it is renewed. There is no flag to shorten this: from here, only \
                 the lease tells whether that process lives",
                named(holder),
                self.run.display()
            );
        }
        POLL_LEASE
    }
}

/// Judges a lock whose last holder has released its lease, or had none, as older programs.
fn without_lease(lock: FileLock, locked_by: Option<Holder>) -> Finding {
    let held = || locked_by.as_ref().is_some_and(Holder::is_older_and_running);
    match lock {
        FileLock::Taken => Finding::Free,
        FileLock::Busy | FileLock::Unsupported if held() => Finding::Held(locked_by),
        FileLock::Busy => Finding::Ending(locked_by),
        FileLock::Unsupported => Finding::Free,
    }
}

fn refused(run: &Path, holder: Option<&Holder>) -> anyhow::Error {
    let run = run.display();
    anyhow::anyhow!("{run} is being trained by {}; stop it, or wait until it ends", named(holder))
}

fn named(holder: Option<&Holder>) -> String {
    holder.map_or_else(|| "another process".to_owned(), ToString::to_string)
}

fn lock_path(run: &Path) -> PathBuf {
    run.join("lock")
}

/// Reads the lock file; `None` if it is empty or cannot be read.
fn read_holder(file: &mut File) -> Option<Holder> {
    let mut text = String::new();
    file.rewind().and_then(|()| file.read_to_string(&mut text)).ok()?;
    Holder::parse(&text)
}

/// Writes the lock file: the process id, as in older programs, and a line of JSON.
fn write_holder(file: &mut File, holder: &Holder) -> std::io::Result<()> {
    let text = format!("{}\n{}\n", holder.pid, serde_json::to_string(holder)?);
    file.set_len(0)?;
    file.rewind()?;
    file.write_all(text.as_bytes())
}
