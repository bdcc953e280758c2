//! Waiting for an answer with a limit, and giving up when the user interrupts.

use std::fmt::{self, Display, Formatter};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use crate::launch;

/// How late an interrupt may be seen.
const LOOK: Duration = Duration::from_millis(20);

/// The user does not want the result any more.
#[derive(Debug)]
pub(super) struct Interrupted;

impl Display for Interrupted {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        formatter.write_str("interrupted")
    }
}

impl std::error::Error for Interrupted {}

/// Sees SIGINT, SIGTERM and SIGHUP, which do not kill this process any more.
pub(crate) struct Watch(Arc<AtomicBool>);

impl Watch {
    /// From now on.
    pub(crate) fn start() -> anyhow::Result<Self> {
        let seen = Arc::new(AtomicBool::new(false));
        // `nohup` has a hang-up ignored, and means that.
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

    /// The next item; none when whoever sends them is gone.
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
