//! Time limits of the supervisor.

use std::time::Duration;

/// Limits of all waits of the supervisor. Users get the defaults; tests use shorter ones.
#[derive(Debug, Clone, Copy)]
pub struct TimeLimits {
    /// From a child's start to its report that it is ready.
    pub ready: Duration,
    /// Added to `ready` for a learner, for each update of its imitation of demonstrations.
    pub cloning_update: Duration,
    /// From an interrupt to the last exit. The rest of the promised ten seconds is for SIGKILL.
    pub stop: Duration,
    /// For a learner that finishes: it drains the queues, writes a checkpoint and exits.
    pub drain: Duration,
    /// From SIGKILL to the exit when the run stops.
    pub kill: Duration,
    /// From SIGKILL to the exit while the run continues: the kernel may free much memory first.
    pub killed: Duration,
    /// For an evaluation, in addition to the time for its episodes.
    pub evaluation: Duration,
    /// For each episode of an evaluation.
    pub evaluation_episode: Duration,
    /// Maximum time without a step or an update.
    pub stall: Duration,
    /// Back-off before the first restart of a child; it doubles with each retry.
    pub restart_first: Duration,
    /// Maximum back-off.
    pub restart_max: Duration,
    /// A child that has worked for this long is not in a crash loop.
    pub proven: Duration,
}

impl Default for TimeLimits {
    fn default() -> Self {
        Self {
            // Imports took a minute on a machine with ten runnable processes for each core.
            ready: Duration::from_secs(300),
            cloning_update: Duration::from_millis(200),
            stop: Duration::from_secs(9),
            drain: Duration::from_secs(60),
            kill: Duration::from_secs(5),
            killed: Duration::from_secs(60),
            evaluation: Duration::from_secs(60),
            evaluation_episode: Duration::from_secs(30),
            stall: Duration::from_secs(600),
            restart_first: Duration::from_millis(100),
            // A worker whose start takes 2 s is back within 3.
            restart_max: Duration::from_secs(1),
            proven: Duration::from_secs(300),
        }
    }
}

impl TimeLimits {
    /// Back-off before restart number `restarts`, from 0.
    #[must_use]
    pub fn back_off(&self, restarts: u32) -> Duration {
        let doubled = 2_u32.checked_pow(restarts).unwrap_or(u32::MAX);
        self.restart_first.saturating_mul(doubled).min(self.restart_max)
    }

    /// Limit of an evaluation with this number of episodes.
    #[must_use]
    pub fn evaluation_of(&self, episodes: usize) -> Duration {
        let episodes = u32::try_from(episodes).unwrap_or(u32::MAX);
        self.evaluation.saturating_add(self.evaluation_episode.saturating_mul(episodes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn back_off_doubles_up_to_its_maximum() {
        let limits = TimeLimits::default();
        let waits = [0, 1, 2, 5, 6, 400].map(|restarts| limits.back_off(restarts).as_millis());
        assert_eq!(waits, [100, 200, 400, 1_000, 1_000, 1_000]);
    }
}
