//! Evaluations asked for and not yet answered: one in flight, the others in order.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crate::control::EvaluationRequest;

/// Requests waiting; full: the oldest is skipped, loudly. An evaluator so far behind never
/// catches up, and its newest policy matters most.
const WAITING_MAX: usize = 64;

#[derive(Debug)]
pub(super) struct EvaluationQueue {
    waiting: VecDeque<EvaluationRequest>,
    in_flight: Option<(EvaluationRequest, Instant)>,
    limit: Duration,
}

impl EvaluationQueue {
    /// `limit`: of one evaluation.
    pub(super) fn new(limit: Duration) -> Self {
        Self { waiting: VecDeque::with_capacity(WAITING_MAX), in_flight: None, limit }
    }

    /// Adds a request; returns the one that was skipped for want of room.
    pub(super) fn push(&mut self, request: EvaluationRequest) -> Option<EvaluationRequest> {
        let skipped =
            if self.waiting.len() == WAITING_MAX { self.waiting.pop_front() } else { None };
        self.waiting.push_back(request);
        skipped
    }

    /// The next request to send, when none is in flight.
    pub(super) fn start(&mut self, now: Instant) -> Option<EvaluationRequest> {
        if self.in_flight.is_some() {
            return None;
        }
        let request = self.waiting.pop_front()?;
        self.in_flight = Some((request.clone(), now + self.limit));
        Some(request)
    }

    /// Gives the one in flight so much more time.
    pub(super) fn postpone(&mut self, time: Duration) {
        if let Some((_, deadline)) = &mut self.in_flight {
            *deadline += time;
        }
    }

    /// Takes the answer for this policy; false when another or none was asked for.
    pub(super) fn finish(&mut self, policy_version: u64) -> bool {
        let asked = |(request, _): &mut (EvaluationRequest, Instant)| {
            request.policy_version == policy_version
        };
        self.in_flight.take_if(asked).is_some()
    }

    /// The evaluator died: what was in flight is to be sent again.
    pub(super) fn send_again(&mut self) {
        if let Some((request, _)) = self.in_flight.take() {
            self.waiting.push_front(request);
        }
    }

    /// When the one in flight has taken too long.
    pub(super) fn deadline(&self) -> Option<Instant> {
        self.in_flight.as_ref().map(|(_, deadline)| *deadline)
    }

    pub(super) fn outstanding(&self) -> usize {
        self.waiting.len() + usize::from(self.in_flight.is_some())
    }

    pub(super) fn clear(&mut self) {
        self.waiting.clear();
        self.in_flight = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(policy_version: u64) -> EvaluationRequest {
        EvaluationRequest { env_steps: 0, updates: 0, segments: 0, wall_s: 0.0, policy_version }
    }

    #[test]
    fn one_is_in_flight_and_goes_first_when_sent_again() {
        let mut queue = EvaluationQueue::new(Duration::from_secs(1));
        assert_eq!(queue.push(request(1)), None);
        assert_eq!(queue.push(request(2)), None);
        assert_eq!(queue.start(Instant::now()), Some(request(1)));
        assert_eq!(queue.start(Instant::now()), None);
        assert!(!queue.finish(2), "2 was not asked for");
        queue.send_again();
        assert_eq!(queue.start(Instant::now()), Some(request(1)));
        assert!(queue.finish(1));
        assert_eq!(queue.outstanding(), 1);
    }

    #[test]
    fn a_full_queue_skips_its_oldest_and_says_which() {
        let mut queue = EvaluationQueue::new(Duration::from_secs(1));
        for version in 0..WAITING_MAX as u64 {
            assert_eq!(queue.push(request(version)), None);
        }
        assert_eq!(queue.push(request(1_000)), Some(request(0)));
        assert_eq!(queue.outstanding(), WAITING_MAX);
    }
}
