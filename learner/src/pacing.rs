//! Keeps the ratio of updates to segments. Each segment adds to the updates that the learner owes.
//!
//! The learner waits when it owes no update. The workers wait, on full queues, when the learner
//! owes the updates of more than `tolerance_segments` segments and takes no more segments.

use dmprl_shared::config::PacingConfig;
use serde::{Deserialize, Serialize};

/// The account of updates owed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pacing {
    updates_per_segment: f64,
    tolerance_segments: u64,
    /// Updates owed, including fractions.
    owed: f64,
}

impl Pacing {
    /// Makes an empty account.
    #[must_use]
    pub fn new(config: &PacingConfig) -> Self {
        Self {
            updates_per_segment: config.updates_per_segment,
            tolerance_segments: config.tolerance_segments,
            owed: 0.0,
        }
    }

    /// Adds the updates owed for one segment.
    pub fn inserted(&mut self) {
        self.owed += self.updates_per_segment;
    }

    /// Subtracts one update.
    pub fn updated(&mut self) {
        self.owed -= 1.0;
    }

    /// Returns whether an update is owed.
    #[must_use]
    pub fn update_due(&self) -> bool {
        self.owed >= 1.0
    }

    /// Returns whether another segment may be taken before the next update. This always holds if no
    /// update is due, so that no configuration makes both sides wait.
    #[must_use]
    pub fn may_take(&self) -> bool {
        !self.update_due() || self.owed < self.tolerance_segments as f64 * self.updates_per_segment
    }

    /// Returns the updates owed, including fractions.
    #[must_use]
    pub fn owed(&self) -> f64 {
        self.owed
    }

    /// Restores the updates owed from a checkpoint. Ratio and tolerance stay as configured.
    pub fn restore(&mut self, owed: f64) {
        self.owed = owed;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(updates_per_segment: f64, segments: usize) -> usize {
        let mut pacing = Pacing::new(&PacingConfig { updates_per_segment, tolerance_segments: 4 });
        let mut updates = 0;
        for _ in 0..segments {
            assert!(pacing.may_take());
            pacing.inserted();
            while pacing.update_due() {
                pacing.updated();
                updates += 1;
            }
        }
        updates
    }

    #[test]
    fn the_ratio_is_met_also_when_it_is_a_fraction() {
        assert_eq!(run(2.0, 100), 200);
        assert_eq!(run(0.25, 100), 25);
        assert_eq!(run(1.5, 100), 150);
    }

    #[test]
    fn a_learner_that_falls_behind_takes_no_more_than_its_tolerance() {
        let config = PacingConfig { updates_per_segment: 0.5, tolerance_segments: 4 };
        let mut pacing = Pacing::new(&config);
        let mut taken = 0;
        while pacing.may_take() {
            pacing.inserted();
            taken += 1;
        }
        assert_eq!(taken, 4);
        assert!(pacing.update_due());
        pacing.updated();
        assert!(pacing.may_take());
    }

    #[test]
    fn no_setting_can_make_both_sides_wait() {
        for updates_per_segment in [0.01, 0.5, 1.0, 3.0] {
            let config = PacingConfig { updates_per_segment, tolerance_segments: 1 };
            let mut pacing = Pacing::new(&config);
            for _ in 0..1_000 {
                assert!(pacing.may_take() || pacing.update_due(), "{pacing:?}");
                if pacing.update_due() { pacing.updated() } else { pacing.inserted() }
            }
        }
    }
}
