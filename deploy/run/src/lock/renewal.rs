//! The thread that renews a lease while its process lives.

use std::fmt::{self, Debug, Formatter};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, OnceLock};
use std::thread::{self, JoinHandle};

use anyhow::Context;
use tracing::warn;

use super::lease::{Lease, RENEWAL, Renewed, TIMEOUT};

/// Tells whether another process has taken the run over. The default is never lost.
#[derive(Debug, Clone, Default)]
pub struct LockWatch(Arc<OnceLock<String>>);

impl LockWatch {
    /// Returns the process that has taken the run over, or `None` if the lock is still held.
    #[must_use]
    pub fn lost_to(&self) -> Option<&str> {
        self.0.get().map(String::as_str)
    }
}

/// A lease that is renewed, until it is dropped or lost.
pub(super) struct Renewal {
    watch: LockWatch,
    // Dropping it ends the thread.
    stop: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Debug for Renewal {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        formatter.debug_tuple("Renewal").field(&self.watch).finish()
    }
}

impl Renewal {
    pub(super) fn start(lease: Lease) -> anyhow::Result<Self> {
        let watch = LockWatch::default();
        let (stop, stopped) = mpsc::channel();
        let lost = watch.clone();
        let thread = thread::Builder::new()
            .name("lease".to_owned())
            .spawn(move || renew(lease, &stopped, &lost))
            .context("cannot start the thread that renews the lease")?;
        Ok(Self { watch, stop: Some(stop), thread: Some(thread) })
    }

    pub(super) fn watch(&self) -> LockWatch {
        self.watch.clone()
    }
}

impl Drop for Renewal {
    fn drop(&mut self) {
        self.stop = None;
        if let Some(thread) = self.thread.take() {
            // The thread does not panic; if it did, the lease would expire.
            let _ = thread.join();
        }
    }
}

fn renew(mut lease: Lease, stopped: &Receiver<()>, lost: &LockWatch) {
    let mut failing = false;
    while stopped.recv_timeout(RENEWAL) == Err(RecvTimeoutError::Timeout) {
        match lease.renew() {
            Ok(Renewed::Held) => failing = false,
            Ok(Renewed::Lost(holder)) => {
                let holder = holder.map_or("another process".to_owned(), |it| it.to_string());
                let _ = lost.0.set(holder);
                return;
            }
            Err(error) if !failing => {
                failing = true;
                warn!(
                    "cannot renew the run's lease: {error}; after {TIMEOUT:?} another host may \
                     take the run over"
                );
            }
            Err(_) => {}
        }
    }
    if let Err(error) = lease.release() {
        warn!("cannot release the run's lease: {error}");
    }
}
