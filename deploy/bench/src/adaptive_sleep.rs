//! Sleep of the receiver when all queues are empty.

use std::time::Duration;

/// Minimum and maximum of a sleep.
const NAP_MIN: Duration = Duration::from_micros(50);
const NAP_MAX: Duration = Duration::from_millis(5);

/// Adapts the receiver's sleep to the fill of the queues. Each wake-up takes time from a worker on
/// its core, but a worker with a full queue loses more.
#[derive(Debug)]
pub(super) struct AdaptiveSleep {
    length: Duration,
    queued_max: usize,
}

impl AdaptiveSleep {
    /// Creates it for queues with a total capacity of `queued_max` segments.
    pub(super) fn new(queued_max: usize) -> Self {
        Self { length: NAP_MIN, queued_max }
    }

    /// Returns the next sleep; `taken` is the number of segments queued during the last one.
    pub(super) fn next(&mut self, taken: usize) -> Duration {
        if taken * 2 > self.queued_max {
            self.length = (self.length / 2).max(NAP_MIN);
        } else if taken * 4 < self.queued_max {
            self.length = (self.length * 5 / 4).min(NAP_MAX);
        }
        self.length
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sink_sleeps_as_long_as_a_quarter_to_a_half_of_the_queues_fills() {
        let mut nap = AdaptiveSleep::new(64);
        let settled = |nap: &mut AdaptiveSleep, taken| (0..100).map(|_| nap.next(taken)).last();
        assert_eq!(settled(&mut nap, 0), Some(NAP_MAX));
        assert_eq!(nap.next(20), NAP_MAX);
        assert_eq!(nap.next(33), NAP_MAX / 2);
        assert_eq!(settled(&mut nap, 64), Some(NAP_MIN));
    }
}
