//! Merges SIGINT, SIGTERM and SIGHUP into one stream of interrupts.

use anyhow::Context;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;

/// Maximum number of waiting interrupts; the third and later ones have no effect.
const INTERRUPTS_MAX: usize = 4;

/// Returns a stream with one item per signal from now on. Must be called inside the runtime.
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
                // If the queue is full, enough interrupts are waiting.
                let _ = sender.try_send(());
            }
        });
    }
    Ok(receiver)
}

/// Whether the parent process made this one ignore a signal, according to the kernel.
pub(crate) fn is_ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status
        .lines()
        .find_map(|line| line.strip_prefix("SigIgn:"))
        .and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}
