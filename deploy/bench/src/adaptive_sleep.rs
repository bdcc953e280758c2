//! The receiver's sleep when all queues are empty.

use std::time::Duration;

/// Minimum and maximum length of a sleep.
const SLEEP_MIN: Duration = Duration::from_micros(50);
const SLEEP_MAX: Duration = Duration::from_millis(5);

/// Adapts the receiver's sleep to the rate at which the queues fill. Each wake-up takes core time
/// from a worker, but a full queue costs the worker more.
#[derive(Debug)]
pub(super) struct AdaptiveSleep {
    length: Duration,
    queued_max: usize,
}

impl AdaptiveSleep {
    /// Creates a sleep for queues with a total capacity of `queued_max` segments.
    pub(super) fn new(queued_max: usize) -> Self {
        Self { length: SLEEP_MIN, queued_max }
    }

    /// Returns the next sleep; `taken` is the number of segments queued during the last one.
    pub(super) fn next(&mut self, taken: usize) -> Duration {
        if taken * 2 > self.queued_max {
            self.length = (self.length / 2).max(SLEEP_MIN);
        } else if taken * 4 < self.queued_max {
            self.length = (self.length * 5 / 4).min(SLEEP_MAX);
        }
        self.length
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sleep_grows_below_a_quarter_full_and_shrinks_above_half_full() {
        let mut sleep = AdaptiveSleep::new(64);
        let settled = |sleep: &mut AdaptiveSleep, taken| (0..100).map(|_| sleep.next(taken)).last();
        assert_eq!(settled(&mut sleep, 0), Some(SLEEP_MAX));
        assert_eq!(sleep.next(20), SLEEP_MAX);
        assert_eq!(sleep.next(33), SLEEP_MAX / 2);
        assert_eq!(settled(&mut sleep, 64), Some(SLEEP_MIN));
    }
}
