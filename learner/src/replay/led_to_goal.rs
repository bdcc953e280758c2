//! Windows that led to a goal, so that the actor can imitate them.
//!
//! With hindsight, a push or a stroke shows which actions are right for the goal at which the
//! object came to lie. Dai et al. 2020, "Episodic self-imitation learning with hindsight", imitate
//! whole episodes. Here only windows that move the object count, because the rest of an episode may
//! be a detour.

use dmprl_shared::goal_rule::GoalReward;

use super::{Goal, Replay, Window};

/// A window moves the achieved goal if its end is farther from its start than this many thresholds.
const WINDOW_MOVES: f64 = 0.3;

impl Replay {
    /// Returns whether the window moves the achieved goal from outside the goal, and its episode
    /// ends within it. The newest step counts as the end of an episode that still runs.
    #[must_use]
    pub fn led_to(&self, window: &Window, goal: Goal<'_>) -> bool {
        let Goal { rule, values } = goal;
        let GoalReward::Sparse { threshold, .. } = rule.reward else { return false };
        if self.slots[window.slot as usize].hindsight {
            return false;
        }
        let start = rule.achieved(self.observation(window));
        let way = rule.distance(start, rule.achieved(self.last_observation(window)));
        let end = rule.achieved(self.last_row(self.live(window.slot).newest));
        way > WINDOW_MOVES * threshold
            && rule.distance(start, values) > threshold
            && rule.distance(end, values) <= threshold
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TRUNCATED};

    use super::*;
    use crate::learner::tests::goal_rule;

    /// Inserts an episode whose observations achieve these goals. Goals are reached within 0.5.
    fn episode(achieved: [f32; 5]) -> Replay {
        let layout = SegmentLayout { segment_steps: 2, observation_len: 2, action_len: 1 };
        let mut replay = Replay::new(layout, 100, 1, 1);
        for (first, flags) in [(0, 0), (2, TRUNCATED)] {
            let mut block = vec![0.0; layout.block_len()];
            let (observations, _, _) = layout.split_mut(&mut block);
            for (step, row) in observations.chunks_exact_mut(2).enumerate() {
                row.copy_from_slice(&[achieved[first + step], 9.0]);
            }
            let episode_step = first as u32;
            let header = SegmentHeader { episode_step, steps_len: 2, flags, ..Default::default() };
            replay.insert(&header, &block);
        }
        replay
    }

    /// Returns whether the windows at steps 0, 1 and 2 led to a goal.
    fn led(replay: &Replay, goal: f32) -> [bool; 3] {
        let rule = goal_rule();
        let goal = Goal { rule: &rule, values: &[goal] };
        [(0, 0), (0, 1), (1, 0)].map(|(slot, offset)| {
            let window = replay.window(slot, offset).unwrap();
            replay.led_to(&window, goal)
        })
    }

    #[test]
    fn windows_that_moved_an_object_whose_episode_ended_at_the_goal_led_to_it() {
        let replay = episode([0.0, 0.0, 2.0, 4.0, 4.0]);
        assert_eq!(led(&replay, 4.0), [true; 3]);
        assert_eq!(led(&replay, 4.5), [true; 3], "within the threshold");
        assert_eq!(led(&replay, 2.0), [false; 3], "the goal was only passed");
        assert_eq!(led(&replay, 5.0), [false; 3], "the goal was missed");
    }

    #[test]
    fn windows_that_moved_nothing_or_began_at_the_goal_did_not_lead_to_it() {
        assert_eq!(led(&episode([0.0, 0.0, 0.1, 4.0, 4.0]), 4.0), [false, true, true]);
        // The object leaves the goal and comes back.
        assert_eq!(led(&episode([4.0, 4.0, 2.0, 2.0, 4.0]), 4.0), [false, false, true]);
    }
}
