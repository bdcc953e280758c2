//! Merges SIGINT, SIGTERM and SIGHUP into one stream of interrupts.

use anyhow::Context;
use dmprl_run::is_ignored;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;

/// Maximum number of queued interrupts. The third and later ones have no effect.
const INTERRUPTS_MAX: usize = 4;

/// Returns a stream with one item per signal from now on. Must be called within a tokio runtime.
///
/// # Errors
/// A signal cannot be caught.
pub fn interrupts() -> anyhow::Result<mpsc::Receiver<()>> {
    let (sender, receiver) = mpsc::channel(INTERRUPTS_MAX);
    let mut kinds = vec![SignalKind::interrupt(), SignalKind::terminate()];
    // `nohup` ignores SIGHUP deliberately.
    if !is_ignored(SignalKind::hangup().as_raw_value()) {
        kinds.push(SignalKind::hangup());
    }
    for kind in kinds {
        let mut signals =
            signal(kind).with_context(|| format!("cannot catch signal {}", kind.as_raw_value()))?;
        let sender = sender.clone();
        tokio::spawn(async move {
            while signals.recv().await.is_some() {
                // If the queue is full, enough interrupts are queued.
                let _ = sender.try_send(());
            }
        });
    }
    Ok(receiver)
}
