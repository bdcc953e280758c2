//! Waits for conditions, with a limit.

use std::thread;
use std::time::{Duration, Instant};

/// Limit of every wait, far beyond the needs of a loaded machine.
pub const PATIENCE: Duration = Duration::from_secs(120);
/// Interval between two checks of a condition.
pub(crate) const POLL: Duration = Duration::from_millis(10);

/// Checks a condition until it holds.
///
/// # Panics
/// If it does not hold within [`PATIENCE`].
pub fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < deadline, "waited {PATIENCE:?} in vain for: {what}");
        thread::sleep(POLL);
    }
}
