//! Detects that the supervisor itself was suspended or late.

use std::time::{Duration, Instant};

/// If the supervisor wakes this long after its own deadline, it was suspended, by Ctrl-Z and `fg`
/// or a paused container, and not only late.
const SUSPENDED: Duration = Duration::from_secs(5);

/// Returns how long the supervisor was suspended, or `None` if it was not. It last ran at `looked`,
/// should have woken at `due` at the latest, and woke at `now`.
pub(super) fn suspension(looked: Instant, due: Instant, now: Instant) -> Option<Duration> {
    (lateness(looked, due, now) >= SUSPENDED).then(|| now.duration_since(looked))
}

/// Returns how long after its deadline the supervisor woke.
pub(super) fn lateness(looked: Instant, due: Instant, now: Instant) -> Duration {
    now.saturating_duration_since(due.max(looked))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: Ctrl-Z for an hour was once taken for an hour without progress.
    #[test]
    fn a_suspension_is_distinguished_from_a_wait() {
        let looked = Instant::now();
        let due = looked + Duration::from_secs(60);
        assert_eq!(suspension(looked, due, looked), None, "an early report");
        assert_eq!(suspension(looked, due, due + Duration::from_millis(20)), None, "a timer");
        let hour = Duration::from_secs(3_600);
        assert_eq!(suspension(looked, due, looked + hour), Some(hour));
        assert_eq!(suspension(due, looked, due), None, "overdue and handled at once");
    }
}
