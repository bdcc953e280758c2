//! Queue of evaluation requests without an answer. At most one is in flight.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use dmprl_control::EvaluationRequest;

/// Maximum number of waiting requests. If the queue is full, the oldest is skipped with a warning:
/// an evaluator this far behind does not catch up, and the newest policy matters most.
const WAITING_MAX: usize = 64;

#[derive(Debug)]
pub(super) struct EvaluationQueue {
    waiting: VecDeque<EvaluationRequest>,
    in_flight: Option<InFlight>,
    /// Maximum duration of an evaluation.
    limit: Duration,
}

/// The request that the evaluator works on.
#[derive(Debug)]
struct InFlight {
    request: EvaluationRequest,
    deadline: Instant,
}

impl EvaluationQueue {
    /// Creates an empty queue. `limit` is the maximum duration of an evaluation.
    pub(super) fn new(limit: Duration) -> Self {
        Self { waiting: VecDeque::with_capacity(WAITING_MAX), in_flight: None, limit }
    }

    /// Adds a request; returns the one that is skipped because the queue is full.
    pub(super) fn push(&mut self, request: EvaluationRequest) -> Option<EvaluationRequest> {
        let skipped =
            if self.waiting.len() == WAITING_MAX { self.waiting.pop_front() } else { None };
        self.waiting.push_back(request);
        skipped
    }

    /// Takes the next request to send, unless one is in flight.
    pub(super) fn start(&mut self, now: Instant) -> Option<EvaluationRequest> {
        if self.in_flight.is_some() {
            return None;
        }
        let request = self.waiting.pop_front()?;
        let deadline = now + self.limit;
        self.in_flight = Some(InFlight { request: request.clone(), deadline });
        Some(request)
    }

    /// Extends the deadline of the request in flight.
    pub(super) fn postpone(&mut self, time: Duration) {
        if let Some(in_flight) = &mut self.in_flight {
            in_flight.deadline += time;
        }
    }

    /// Accepts the answer for this policy; returns false if no such request is in flight.
    pub(super) fn finish(&mut self, policy_version: u64) -> bool {
        let matches = |in_flight: &mut InFlight| in_flight.request.policy_version == policy_version;
        self.in_flight.take_if(matches).is_some()
    }

    /// Accepts the answer of an evaluator that was killed because it took too long, so that its
    /// request waits to be sent again; returns false if no such request waits.
    pub(super) fn finish_late(&mut self, policy_version: u64) -> bool {
        let matches = |request: &EvaluationRequest| request.policy_version == policy_version;
        let waits = self.waiting.front().is_some_and(matches);
        if waits {
            self.waiting.pop_front();
        }
        waits
    }

    /// Puts the request in flight back to the front of the queue, after the evaluator died.
    pub(super) fn send_again(&mut self) {
        if let Some(in_flight) = self.in_flight.take() {
            self.waiting.push_front(in_flight.request);
        }
    }

    /// Deadline of the request in flight.
    pub(super) fn deadline(&self) -> Option<Instant> {
        self.in_flight.as_ref().map(|in_flight| in_flight.deadline)
    }

    /// Number of requests without an answer.
    pub(super) fn outstanding(&self) -> usize {
        self.waiting.len() + usize::from(self.in_flight.is_some())
    }

    /// Versions of all requests, the one in flight first.
    #[cfg(test)]
    pub(super) fn versions(&self) -> Vec<u64> {
        let in_flight = self.in_flight.iter().map(|in_flight| &in_flight.request);
        in_flight.chain(&self.waiting).map(|request| request.policy_version).collect()
    }

    /// Removes and returns all requests, the one in flight first.
    pub(super) fn clear(&mut self) -> Vec<EvaluationRequest> {
        let in_flight = self.in_flight.take().map(|in_flight| in_flight.request);
        in_flight.into_iter().chain(self.waiting.drain(..)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(policy_version: u64) -> EvaluationRequest {
        EvaluationRequest { env_steps: 0, updates: 0, segments: 0, wall_s: 0.0, policy_version }
    }

    #[test]
    fn one_request_is_in_flight_and_a_repeated_one_comes_first() {
        let mut queue = EvaluationQueue::new(Duration::from_secs(1));
        assert_eq!(queue.push(request(1)), None);
        assert_eq!(queue.push(request(2)), None);
        assert_eq!(queue.start(Instant::now()), Some(request(1)));
        assert_eq!(queue.start(Instant::now()), None);
        assert!(!queue.finish(2), "2 is not in flight");
        queue.send_again();
        assert_eq!(queue.start(Instant::now()), Some(request(1)));
        assert!(queue.finish(1));
        assert_eq!(queue.outstanding(), 1);
    }

    #[test]
    fn a_full_queue_skips_and_returns_its_oldest_request() {
        let mut queue = EvaluationQueue::new(Duration::from_secs(1));
        for version in 0..WAITING_MAX as u64 {
            assert_eq!(queue.push(request(version)), None);
        }
        assert_eq!(queue.push(request(1_000)), Some(request(0)));
        assert_eq!(queue.outstanding(), WAITING_MAX);
    }
}
