//! Waits for answers with a time limit, and until the user interrupts.

use std::fmt::{self, Display, Formatter};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use crate::launch;

/// Maximum delay until an interrupt is noticed.
const LOOK: Duration = Duration::from_millis(20);

/// Error for an interrupt by the user.
#[derive(Debug)]
pub(super) struct Interrupted;

impl Display for Interrupted {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        formatter.write_str("interrupted")
    }
}

impl std::error::Error for Interrupted {}

/// Catches SIGINT, SIGTERM and SIGHUP, which then no longer kill this process.
pub(crate) struct Watch(Arc<AtomicBool>);

impl Watch {
    /// Starts to catch the signals.
    pub(crate) fn start() -> anyhow::Result<Self> {
        let seen = Arc::new(AtomicBool::new(false));
        // `nohup` ignores SIGHUP on purpose, so leave it ignored.
        let hang_up = (!launch::is_ignored(SIGHUP)).then_some(SIGHUP);
        for signal in [SIGINT, SIGTERM].into_iter().chain(hang_up) {
            signal_hook::flag::register(signal, Arc::clone(&seen))
                .with_context(|| format!("cannot catch signal {signal}"))?;
        }
        Ok(Self(seen))
    }

    /// Fails with [`Interrupted`] once the user has interrupted.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        if self.0.load(Ordering::Acquire) { Err(Interrupted.into()) } else { Ok(()) }
    }

    /// Returns the next item, or `None` if the sender is gone.
    pub(super) fn next<T>(
        &self,
        items: &Receiver<T>,
        limit: Duration,
        what: &str,
    ) -> anyhow::Result<Option<T>> {
        let deadline = Instant::now() + limit;
        loop {
            self.check()?;
            match items.recv_timeout(LOOK) {
                Ok(item) => return Ok(Some(item)),
                Err(RecvTimeoutError::Disconnected) => return Ok(None),
                Err(RecvTimeoutError::Timeout) if Instant::now() >= deadline => {
                    bail!("{what} did not come within {limit:?}")
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }
}
