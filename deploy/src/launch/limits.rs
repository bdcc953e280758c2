//! How long the supervisor waits for what.

use std::time::Duration;

/// Every wait of the supervisor, named. Tests shorten them; users get the defaults.
#[derive(Debug, Clone, Copy)]
pub struct TimeLimits {
    /// From a child's start to its report that it is ready.
    pub ready: Duration,
    /// More for a learner, for each update in which it imitates demonstrations first.
    pub cloning_update: Duration,
    /// From an interrupt to the last exit; the rest of ten seconds is for SIGKILL.
    pub stop: Duration,
    /// For a learner that comes to a regular end: it drains, writes a checkpoint, exits.
    pub drain: Duration,
    /// From SIGKILL to the exit.
    pub kill: Duration,
    /// One evaluation whatever its length,
    pub evaluation: Duration,
    /// and for each of its episodes.
    pub evaluation_episode: Duration,
    /// Without a step or an update a run is stuck.
    pub stall: Duration,
    /// Before the first restart of a child; doubles with each further one,
    pub restart_first: Duration,
    /// up to this.
    pub restart_max: Duration,
    /// A child that did its work for so long is no crash loop: its next death is its first.
    pub proven: Duration,
}

impl Default for TimeLimits {
    fn default() -> Self {
        Self {
            ready: Duration::from_secs(60),
            cloning_update: Duration::from_millis(200),
            stop: Duration::from_secs(9),
            drain: Duration::from_secs(60),
            kill: Duration::from_secs(5),
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
    /// The wait before restart number `restarts`, from 0.
    #[must_use]
    pub fn back_off(&self, restarts: u32) -> Duration {
        let doubled = 2_u32.checked_pow(restarts).unwrap_or(u32::MAX);
        self.restart_first.saturating_mul(doubled).min(self.restart_max)
    }

    /// The limit of an evaluation of so many episodes.
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
    fn back_off_doubles_up_to_its_cap() {
        let limits = TimeLimits::default();
        let waits = [0, 1, 2, 5, 6, 400].map(|restarts| limits.back_off(restarts).as_millis());
        assert_eq!(waits, [100, 200, 400, 1_000, 1_000, 1_000]);
    }
}
