//! Congestion window: limits the data that a host may have in flight.
//!
//! With too little, a long link is never filled. With too much, segments of a fast host queue for a
//! slow learner and become outdated. The right amount is what the learner acknowledges in one round
//! trip, as in BBR (Cardwell et al. 2016): the fastest recent rate of acknowledgements times the
//! shortest recent round trip. Only the link's round trip to the gateway and back counts, so that a
//! slow learner does not make the link seem longer.

/// Added to a round trip: some intervals of acknowledgements, and the time of an update \[s\].
const SLACK_S: f64 = 0.05;
/// Factor of the window, so that a higher rate can be measured if the link allows it.
const GAIN: f64 = 2.0;
/// Minimum time over which a rate is measured \[s\]. The window uses the fastest of the last
/// `RATES` rates.
const RATE_S: f64 = 0.1;
const RATES: usize = 8;
/// The shortest round trip is taken over the last one or two intervals of this length \[s\].
const MEMORY_S: f64 = 10.0;
/// Minimum window \[bytes\]: some segments of each of some environments.
const WINDOW_MIN: f64 = 65_536.0;

/// The congestion window of a host.
#[derive(Debug, Clone)]
pub struct CongestionWindow {
    max: f64,
    /// Shortest round trip in the current and in the previous interval \[s\], and the start of the
    /// current one \[s\].
    round_trips: [f64; 2],
    began_s: f64,
    /// The last rates \[bytes/s\], and the bytes acknowledged since the newest.
    rates: [f64; RATES],
    next: usize,
    acknowledged: u64,
    since_s: f64,
}

impl CongestionWindow {
    /// Creates the minimum window, which can grow to `bytes_max`.
    #[must_use]
    pub fn new(bytes_max: u64) -> Self {
        Self {
            max: (bytes_max as f64).max(WINDOW_MIN),
            round_trips: [f64::INFINITY; 2],
            began_s: 0.0,
            rates: [0.0; RATES],
            next: 0,
            acknowledged: 0,
            since_s: 0.0,
        }
    }

    /// Number of bytes that may be in flight.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        let rate = self.rates.into_iter().fold(0.0, f64::max);
        let needed = rate * (self.round_trip_s().unwrap_or(0.0) + SLACK_S);
        (GAIN * needed).clamp(WINDOW_MIN, self.max) as u64
    }

    fn round_trip_s(&self) -> Option<f64> {
        let shortest = self.round_trips[0].min(self.round_trips[1]);
        shortest.is_finite().then_some(shortest)
    }

    /// Records, at time `now_s`, a round trip: the gateway confirmed a segment sent `round_trip_s`
    /// ago.
    pub fn record_round_trip(&mut self, round_trip_s: f64, now_s: f64) {
        if now_s - self.began_s >= MEMORY_S {
            self.round_trips = [f64::INFINITY, self.round_trips[0]];
            self.began_s = now_s;
        }
        self.round_trips[0] = self.round_trips[0].min(round_trip_s);
    }

    /// Records, at time `now_s`, that `bytes` more bytes have been acknowledged.
    pub fn acknowledge(&mut self, bytes: u64, now_s: f64) {
        self.acknowledged += bytes;
        let seconds = now_s - self.since_s;
        if seconds >= RATE_S.max(self.round_trip_s().unwrap_or(0.0)) {
            self.rates[self.next] = self.acknowledged as f64 / seconds;
            self.next = (self.next + 1) % RATES;
            (self.acknowledged, self.since_s) = (0, now_s);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use super::*;

    /// Simulates for a minute a link of `round_trip_s` to a learner that takes `bytes_per_s`.
    /// Returns the learner's rate in the second half \[bytes/s\] and the longest delay of an
    /// acknowledgement in it.
    fn run(round_trip_s: f64, bytes_per_s: f64) -> (f64, f64) {
        const STEP_S: f64 = 0.005;
        const STEPS: u32 = 12_000;
        let mut window = CongestionWindow::new(64 << 20);
        // Arrival time, sending time, size.
        let (mut link, mut acks) = (VecDeque::new(), VecDeque::new());
        let mut received: VecDeque<(f64, f64)> = VecDeque::new();
        let (mut in_flight, mut taken, mut delay_max) = (0.0, 0.0, 0.0_f64);
        for step in 0..STEPS {
            let now_s = f64::from(step) * STEP_S;
            let sent = (window.bytes() as f64 - in_flight).max(0.0);
            in_flight += sent;
            link.push_back((now_s + round_trip_s / 2.0, now_s, sent));
            received.push_back((now_s + round_trip_s + STEP_S, now_s));
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
            while let Some((_, sent_s)) = received.front().filter(|(at, _)| *at <= now_s) {
                window.record_round_trip(now_s - sent_s, now_s);
                received.pop_front();
            }
            while let Some((_, sent_s, bytes)) = acks.front().copied().filter(|ack| ack.0 <= now_s)
            {
                acks.pop_front();
                window.acknowledge(bytes as u64, now_s);
                in_flight -= bytes;
                if step >= STEPS / 2 {
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
        assert!(taken > 0.95 * 40e6, "{taken}");
    }

    #[test]
    fn segments_do_not_queue_up_for_a_slow_learner() {
        for (round_trip_s, longest_s) in [(0.001, 0.25), (0.2, 0.8)] {
            let (taken, delay_s) = run(round_trip_s, 2e6);
            assert!(taken > 0.95 * 2e6, "{taken}");
            assert!(delay_s < longest_s, "{delay_s}");
        }
    }
}
