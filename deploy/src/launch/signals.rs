//! SIGINT, SIGTERM and SIGHUP as one stream of interrupts.

use anyhow::Context;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;

/// More than two interrupts mean no more than two.
const INTERRUPTS_MAX: usize = 4;

/// One item for each signal from now on. Call it inside the runtime.
///
/// # Errors
/// A signal cannot be caught.
pub fn interrupts() -> anyhow::Result<mpsc::Receiver<()>> {
    let (sender, receiver) = mpsc::channel(INTERRUPTS_MAX);
    let mut kinds = vec![SignalKind::interrupt(), SignalKind::terminate()];
    // `nohup` has it ignored, and means that.
    if !is_ignored(SignalKind::hangup().as_raw_value()) {
        kinds.push(SignalKind::hangup());
    }
    for kind in kinds {
        let mut signals =
            signal(kind).with_context(|| format!("cannot catch signal {}", kind.as_raw_value()))?;
        let sender = sender.clone();
        tokio::spawn(async move {
            while signals.recv().await.is_some() {
                // Full: more interrupts than mean anything wait already.
                let _ = sender.try_send(());
            }
        });
    }
    Ok(receiver)
}

/// Whether whoever started us had this signal ignored, as the kernel tells it.
pub(crate) fn is_ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status
        .lines()
        .find_map(|line| line.strip_prefix("SigIgn:"))
        .and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}
