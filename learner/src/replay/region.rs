//! The region of a task: the box around the goals that the environment asks for and the achieved
//! goals at which its episodes start.
//!
//! An early policy strikes objects out of the region, off the table for instance. Goals out there
//! teach little about those that the environment asks for, so hindsight prefers goals in the
//! region. It is our own addition.

use dmprl_shared::goal_rule::{GoalReward, GoalRule};

use super::Replay;

/// The box, with a margin of one threshold of the goal. Without a threshold, or before the first
/// episodes, it contains every goal.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Region {
    /// Smallest and largest value of each entry of a goal.
    ranges: Vec<[f32; 2]>,
}

impl Region {
    /// Returns the region of the episodes that have one of the recent `slots`.
    pub(super) fn new(rule: &GoalRule, replay: &Replay, slots: &[u32]) -> Self {
        let GoalReward::Sparse { threshold, .. } = rule.reward else { return Self::default() };
        let mut ranges = Vec::new();
        for &slot in slots {
            let row = replay.observation_row(slot, 0);
            widen(&mut ranges, rule.desired(row));
            if replay.rank(slot) == 0 {
                widen(&mut ranges, rule.achieved(row));
            }
        }
        let margin = threshold as f32;
        ranges.iter_mut().for_each(|range| *range = [range[0] - margin, range[1] + margin]);
        Self { ranges }
    }

    /// Returns whether a goal, (G,), is in the region.
    pub(super) fn contains(&self, goal: &[f32]) -> bool {
        self.ranges.iter().zip(goal).all(|(range, value)| (range[0]..=range[1]).contains(value))
    }
}

/// Widens ranges to include a goal. Ranges without an entry become that goal.
pub(super) fn widen(ranges: &mut Vec<[f32; 2]>, goal: &[f32]) {
    if ranges.is_empty() {
        ranges.extend(goal.iter().map(|&value| [value, value]));
    }
    for (range, &value) in ranges.iter_mut().zip(goal) {
        *range = [range[0].min(value), range[1].max(value)];
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::segment::{SegmentHeader, SegmentLayout};

    use super::*;
    use crate::learner::tests::goal_rule;

    #[test]
    fn the_region_spans_desired_goals_and_starts_with_a_margin_of_one_threshold() {
        // Observations are (achieved goal, desired goal). The episode of two segments starts at 2.
        let layout = SegmentLayout { segment_steps: 1, observation_len: 2, action_len: 1 };
        let mut replay = Replay::new(layout, 20, 1, 1);
        for (episode_step, achieved) in [(0, 2.0), (1, -30.0)] {
            let header = SegmentHeader { episode_step, steps_len: 1, ..Default::default() };
            replay.insert(&header, &[achieved, 9.0, -30.0, 9.0, 0.1, -1.0]);
        }
        let reward = GoalReward::Sparse { threshold: 0.5, reached: 0.0, missed: -1.0 };
        let rule = GoalRule { reward, ..goal_rule() };
        let region = Region::new(&rule, &replay, &[0, 1]);
        let contains = |region: &Region| [1.4, 1.6, 9.4, 9.6].map(|goal| region.contains(&[goal]));
        assert_eq!(contains(&region), [false, true, true, false]);
        let everything = [true; 4];
        assert_eq!(contains(&Region::new(&rule, &replay, &[])), everything, "no episodes");
        let dense = GoalRule { reward: GoalReward::Dense { factor: -1.0 }, ..rule };
        assert_eq!(contains(&Region::new(&dense, &replay, &[0, 1])), everything, "no threshold");
    }
}
