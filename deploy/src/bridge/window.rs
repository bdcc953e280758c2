//! How much a host may have under way.
//!
//! Too little, and a long link is never filled; too much, and the segments of a fast host wait
//! behind a slow learner, made by a policy that is long replaced. So the window follows the delay
//! from sending to the learner's acknowledgement, as LEDBAT (RFC 6817) does: it grows while that is
//! near the shortest seen lately, and shrinks when what is under way only waits.

/// What may wait beyond the shortest delay before the window shrinks \[s\]. Some times the interval
/// of acknowledgements, a hundredth of a second.
const WAITING_S: f64 = 0.1;
/// The shortest delay is that of the last one or two of these intervals \[s\].
const MEMORY_S: f64 = 10.0;
/// A window never is smaller \[bytes\]: some segments of each of some environments.
const WINDOW_MIN: f64 = 65_536.0;
/// At most so much of what is acknowledged is taken away again.
const SHRINK_MAX: f64 = 0.5;

/// A host's window.
#[derive(Debug, Clone)]
pub struct Window {
    bytes: f64,
    max: f64,
    /// Shortest delay in this interval and in the one before \[s\].
    shortest: [f64; 2],
    /// Of this interval \[s\].
    began_s: f64,
    waiting_s: f64,
}

impl Window {
    /// The smallest, which may grow to `bytes_max`.
    #[must_use]
    pub fn new(bytes_max: u64) -> Self {
        let max = (bytes_max as f64).max(WINDOW_MIN);
        let shortest = [f64::INFINITY; 2];
        Self { bytes: WINDOW_MIN, max, shortest, began_s: 0.0, waiting_s: 0.0 }
    }

    /// Bytes that may be under way.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes as u64
    }

    /// A segment was acknowledged `delay_s` after it was sent, at the time `now_s`.
    pub fn time(&mut self, delay_s: f64, now_s: f64) {
        if now_s - self.began_s >= MEMORY_S {
            self.shortest = [f64::INFINITY, self.shortest[0]];
            self.began_s = now_s;
        }
        self.shortest[0] = self.shortest[0].min(delay_s);
        let shortest = self.shortest[0].min(self.shortest[1]);
        self.waiting_s = delay_s - shortest;
    }

    /// So many bytes were acknowledged, of `under_way` before.
    pub fn acknowledged(&mut self, bytes: u64, under_way: u64) {
        let off = (1.0 - self.waiting_s / WAITING_S).max(-SHRINK_MAX);
        // A window that nobody fills says nothing about what it could be.
        if off > 0.0 && (under_way as f64) < self.bytes / 2.0 {
            return;
        }
        self.bytes = (self.bytes + off * bytes as f64).clamp(WINDOW_MIN, self.max);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use super::*;

    /// A link of `round_trip_s` to a learner that takes `bytes_per_s`, for a minute; what it took
    /// in the second half \[bytes/s\], and the longest delay in it.
    fn run(round_trip_s: f64, bytes_per_s: f64) -> (f64, f64) {
        const STEP_S: f64 = 0.01;
        let mut window = Window::new(64 << 20);
        // When it arrives, when it was sent, how much it is.
        let (mut link, mut acks) = (VecDeque::new(), VecDeque::new());
        let (mut under_way, mut taken, mut delay_max) = (0.0, 0.0, 0.0_f64);
        for step in 0..6_000 {
            let now_s = f64::from(step) * STEP_S;
            let sent = (window.bytes() as f64 - under_way).max(0.0);
            under_way += sent;
            link.push_back((now_s + round_trip_s / 2.0, now_s, sent));
            let mut room = bytes_per_s * STEP_S;
            while let Some((_, sent_s, bytes)) = link.front_mut().filter(|(at, ..)| *at <= now_s) {
                let part = f64::min(*bytes, room);
                (*bytes, room) = (*bytes - part, room - part);
                acks.push_back((now_s + round_trip_s / 2.0 + STEP_S, *sent_s, part));
                if *bytes > 0.0 {
                    break;
                }
                link.pop_front();
            }
            while let Some((_, sent_s, bytes)) = acks.front().copied().filter(|ack| ack.0 <= now_s)
            {
                acks.pop_front();
                window.time(now_s - sent_s, now_s);
                window.acknowledged(bytes as u64, under_way as u64);
                under_way -= bytes;
                if step >= 3_000 {
                    taken += bytes;
                    delay_max = delay_max.max(now_s - sent_s);
                }
            }
        }
        (taken / 30.0, delay_max)
    }

    #[test]
    fn a_long_link_is_filled() {
        let (taken, _) = run(0.2, 40e6);
        assert!(taken > 0.9 * 40e6, "{taken}");
    }

    #[test]
    fn a_slow_learner_is_not_run_ahead_of() {
        let (taken, delay_s) = run(0.001, 1e6);
        assert!(taken > 0.9 * 1e6, "{taken}");
        assert!(delay_s < 0.5, "{delay_s}");
    }
}
