//! Counts over all processes of a run.

use dmprl_shared::transport::delivery::Sent;

/// Counts of a run's earlier sessions, from its newest checkpoint, or of this session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Totals {
    /// Failures of environments.
    pub env_failures: u64,
    /// Numbers of segments that workers have produced and sent, and that were acknowledged.
    pub sent: Sent,
    /// Restarts of the learner after a death.
    pub learner_restarts: u64,
    /// Restarts of workers after a death.
    pub worker_restarts: u64,
}

impl Totals {
    /// Returns the sums of both counts.
    #[must_use]
    pub fn plus(mut self, more: &Self) -> Self {
        self.env_failures = self.env_failures.saturating_add(more.env_failures);
        self.sent += more.sent;
        self.learner_restarts += more.learner_restarts;
        self.worker_restarts += more.worker_restarts;
        self
    }

    /// Adds failures of environments. Returns whether to show the last of them: so that frequent
    /// failures do not fill the terminal, this is true for the first one and then whenever the
    /// count has doubled.
    pub(super) fn add_env_failures(&mut self, count: u64) -> bool {
        let before = self.env_failures;
        self.env_failures = before.saturating_add(count);
        is_shown(before, self.env_failures)
    }
}

/// Whether there is a power of two in `before + 1..=after`.
fn is_shown(before: u64, after: u64) -> bool {
    after > before && after.checked_ilog2() != before.checked_ilog2()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_and_every_doubling_are_shown() {
        let shown: Vec<u64> = (1..=40).filter(|&count| is_shown(count - 1, count)).collect();
        assert_eq!(shown, [1, 2, 4, 8, 16, 32]);
        assert!(is_shown(5, 9) && !is_shown(5, 7) && !is_shown(3, 3) && !is_shown(0, 0));
    }
}
