//! How long the sink sleeps when it has found every queue empty.

use std::time::Duration;

/// Bounds of a sleep.
const NAP_MIN: Duration = Duration::from_micros(50);
const NAP_MAX: Duration = Duration::from_millis(5);

/// The sink's sleep, as long as the queues bear: each waking takes time from a worker on its core,
/// and a worker whose queue is full loses more.
#[derive(Debug)]
pub(super) struct Nap {
    length: Duration,
    queued_max: usize,
}

impl Nap {
    /// For queues that together hold `queued_max` segments.
    pub(super) fn new(queued_max: usize) -> Self {
        Self { length: NAP_MIN, queued_max }
    }

    /// The next sleep; `taken`: what had queued up during the last.
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
        let mut nap = Nap::new(64);
        let settled = |nap: &mut Nap, taken| (0..100).map(|_| nap.next(taken)).last();
        assert_eq!(settled(&mut nap, 0), Some(NAP_MAX));
        assert_eq!(nap.next(20), NAP_MAX);
        assert_eq!(nap.next(33), NAP_MAX / 2);
        assert_eq!(settled(&mut nap, 64), Some(NAP_MIN));
    }
}
