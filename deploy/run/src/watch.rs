//! Waits with a time limit and for interrupts, without an async runtime.

use std::fmt::{self, Display, Formatter};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

/// Interval at which a wait checks for an interrupt.
const POLL: Duration = Duration::from_millis(20);

/// Error for an interrupt by the user.
#[derive(Debug)]
pub struct Interrupted;

impl Display for Interrupted {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        formatter.write_str("interrupted")
    }
}

impl std::error::Error for Interrupted {}

/// Catches SIGINT, SIGTERM and SIGHUP, which then no longer kill this process.
pub struct Watch(Arc<AtomicBool>);

impl Watch {
    /// Starts to catch the signals.
    ///
    /// # Errors
    /// A signal cannot be caught.
    pub fn start() -> anyhow::Result<Self> {
        let seen = Arc::new(AtomicBool::new(false));
        // `nohup` ignores SIGHUP on purpose, so leave it ignored.
        let hang_up = (!is_ignored(SIGHUP)).then_some(SIGHUP);
        for signal in [SIGINT, SIGTERM].into_iter().chain(hang_up) {
            signal_hook::flag::register(signal, Arc::clone(&seen))
                .with_context(|| format!("cannot catch signal {signal}"))?;
        }
        Ok(Self(seen))
    }

    /// Fails with [`Interrupted`] after an interrupt.
    ///
    /// # Errors
    /// The user has interrupted the program.
    pub fn check(&self) -> anyhow::Result<()> {
        if self.0.load(Ordering::Acquire) { Err(Interrupted.into()) } else { Ok(()) }
    }

    /// Waits for the next item; returns `None` if the sender is dropped.
    ///
    /// - `what`: the item, for the error.
    ///
    /// # Errors
    /// The user interrupted, or no item arrived within `limit`.
    pub fn next<T>(
        &self,
        items: &Receiver<T>,
        limit: Duration,
        what: &str,
    ) -> anyhow::Result<Option<T>> {
        let deadline = Instant::now() + limit;
        loop {
            self.check()?;
            match items.recv_timeout(POLL) {
                Ok(item) => return Ok(Some(item)),
                Err(RecvTimeoutError::Disconnected) => return Ok(None),
                Err(RecvTimeoutError::Timeout) if Instant::now() >= deadline => {
                    bail!("{what} did not arrive within {limit:?}")
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }
}

/// Returns true if this process ignores a signal, as inherited from its parent, according to the
/// kernel.
#[must_use]
pub fn is_ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status
        .lines()
        .find_map(|line| line.strip_prefix("SigIgn:"))
        .and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}
