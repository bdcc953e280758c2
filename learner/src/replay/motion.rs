//! Motion of the achieved goal, such as that of an object to push.
//!
//! Random actions rarely touch an object, so most windows come from episodes in which it did not
//! move, and the learner cannot learn from them how to move it. Two remedies, which are our own:
//! 1. A share of the windows comes from episodes that moved the achieved goal.
//! 2. A step that moves it gets a bonus while fewer than half of the recent episodes moved it. The
//!    bonus is added when a batch is sampled, so it starts and ends for all windows at once.

use dmprl_shared::goal_rule::{GoalReward, GoalRule};

use super::hindsight::Goal;
use super::{Replay, Sampler, Window};

/// An episode moves the achieved goal if its end is farther from its start than this many
/// thresholds of the goal.
const EPISODE_MOVES: f64 = 0.4;
/// A step moves the achieved goal if it does so by more than this many thresholds.
const STEP_MOVES: f64 = 0.04;
/// Newest segments whose episodes are counted.
const RECENT_SEGMENTS: u64 = 600;
/// Inserted segments between two counts.
const COUNT_EVERY: u64 = 100;
/// Share of the recent episodes below which steps get a bonus.
const RARE: f64 = 0.5;
/// Draws after which a window is taken from any episode.
const DRAWS_MAX: usize = 30;

/// Prefers and rewards motion, with a sparse reward. Its threshold is the unit of distances.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Motion {
    threshold: f64,
    /// Share of the windows from episodes that moved the achieved goal.
    share: f64,
    /// Reward of a step that moves the achieved goal, while few episodes do.
    bonus: f32,
    is_rare: bool,
    /// Number of inserted segments for which `is_rare` is due.
    due: u64,
}

impl Motion {
    /// Makes the remedies for a rule. `factor` is the bonus, in units of the difference between a
    /// reached goal's reward and a missed one's. Returns `None` if both are off or the reward is
    /// dense.
    pub(super) fn new(rule: &GoalRule, share: f64, factor: f64) -> Option<Self> {
        let GoalReward::Sparse { threshold, reached, missed } = rule.reward else { return None };
        let bonus = (factor * (reached - missed)) as f32;
        (share > 0.0 || factor > 0.0).then_some(Self {
            threshold,
            share,
            bonus,
            is_rare: false,
            due: 0,
        })
    }

    /// Counts the recent episodes, if a count is due. It covers segments that a replay still has
    /// when the next count is due, so a resumed run gets the same result.
    pub(super) fn count(&mut self, rule: &GoalRule, replay: &Replay) {
        let inserted = replay.inserted - replay.inserted % COUNT_EVERY;
        if self.bonus == 0.0 || inserted < self.due {
            return;
        }
        self.due = inserted + COUNT_EVERY;
        let newest = replay.inserted - inserted;
        let ring = (replay.slots.len() - replay.demonstrations) as u64;
        let (mut ended, mut moved) = (0_u32, 0_u32);
        let recent = RECENT_SEGMENTS.min(ring.saturating_sub(COUNT_EVERY)).min(inserted);
        for back in newest..newest + recent {
            let Some(slot) = replay.slot_before(back) else { break };
            let segment = &replay.slots[slot as usize];
            if segment.terminated || segment.truncated {
                ended += 1;
                moved += u32::from(self.moved(rule, replay, slot));
            }
        }
        self.is_rare = f64::from(moved) < RARE * f64::from(ended);
    }

    /// Returns the bonus of a step that moves the achieved goal, 0 while many episodes do.
    pub(super) fn bonus(&self) -> f32 {
        if self.is_rare { self.bonus } else { 0.0 }
    }

    /// Draws a window, with probability `share` from an episode that moved the achieved goal.
    pub(super) fn draw(
        &self,
        rule: &GoalRule,
        replay: &Replay,
        sampler: &mut Sampler,
    ) -> Option<Window> {
        let mut window = sampler.draw(replay)?;
        if !sampler.flip(self.share) {
            return Some(window);
        }
        for _ in 1..DRAWS_MAX {
            if self.moved(rule, replay, window.slot) {
                break;
            }
            window = sampler.draw(replay)?;
        }
        Some(window)
    }

    /// Returns whether the live part of an episode ends far from where it began.
    fn moved(&self, rule: &GoalRule, replay: &Replay, slot: u32) -> bool {
        let live = replay.live(slot);
        let Some(first) = replay.slot_at(live.newest, live.first_rank) else { return false };
        let steps = usize::from(replay.slots[live.newest as usize].steps_len);
        let start = rule.achieved(replay.observation_row(first, 0));
        let end = rule.achieved(replay.observation_row(live.newest, steps));
        rule.distance(start, end) > EPISODE_MOVES * self.threshold
    }

    /// Returns whether step `step` of a window, counted from 1, moves the achieved goal.
    pub(super) fn step_moves(
        &self,
        rule: &GoalRule,
        replay: &Replay,
        window: &Window,
        step: usize,
    ) -> bool {
        let before =
            Goal { rule, values: rule.achieved(replay.observation_after(window, step - 1)) };
        replay.goal_distance(window, step, before) > STEP_MOVES * self.threshold
    }
}

impl Replay {
    /// Returns the slot of the segment that was inserted `back` segments before the newest, of
    /// those that replace each other.
    fn slot_before(&self, back: u64) -> Option<u32> {
        let ring = self.slots.len() - self.demonstrations;
        let position = self.head.checked_sub(self.demonstrations)? + 2 * ring;
        let slot = self.demonstrations + position.checked_sub(1 + back as usize)? % ring;
        (slot < self.filled).then_some(slot as u32)
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Windows;
    use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TRUNCATED};

    use super::*;
    use crate::learner::tests::goal_rule;

    /// Observations are (achieved goal, desired goal).
    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 2, observation_len: 2, action_len: 1 };

    fn rule() -> GoalRule {
        let reward = GoalReward::Sparse { threshold: 1.0, reached: 0.0, missed: -2.0 };
        GoalRule { reward, ..goal_rule() }
    }

    /// Inserts an episode of two segments that achieves 0, 0, `step`, `step`, `step`.
    fn episode(replay: &mut Replay, number: u32, step: f32) {
        let first = [0.0, 9.0, 0.0, 9.0, step, 9.0, 0.1, 0.2, -2.0, -2.0];
        let second = [step, 9.0, step, 9.0, step, 9.0, 0.1, 0.2, -2.0, -2.0];
        for (block, episode_step, flags) in [(first, 0, 0), (second, 2, TRUNCATED)] {
            let header = SegmentHeader {
                episode: number,
                episode_step,
                steps_len: 2,
                flags,
                ..SegmentHeader::default()
            };
            replay.insert(&header, &block);
        }
    }

    fn motion(share: f64) -> Motion {
        Motion::new(&rule(), share, 1.0).unwrap()
    }

    #[test]
    fn steps_get_a_bonus_only_while_few_recent_episodes_move_the_goal() {
        let mut replay = Replay::new(LAYOUT, 2_000, 1, 1);
        let mut motion = motion(0.0);
        motion.count(&rule(), &replay);
        assert_eq!(motion.bonus(), 0.0, "no episode has ended");
        for number in 0..50 {
            episode(&mut replay, number, if number < 24 { 0.5 } else { 0.3 });
        }
        motion.count(&rule(), &replay);
        assert_eq!(motion.bonus(), 2.0, "24 of 50");
        episode(&mut replay, 50, 0.5);
        motion.count(&rule(), &replay);
        assert_eq!(motion.bonus(), 2.0, "the next count is due after 100 segments");
        for number in 51..100 {
            episode(&mut replay, number, 0.5);
        }
        motion.count(&rule(), &replay);
        assert_eq!(motion.bonus(), 0.0, "74 of 100");
    }

    #[test]
    fn a_count_that_is_made_later_is_the_same() {
        // In the smaller ring the later episodes replace some of the first ones.
        for capacity in [2_000, 400] {
            let mut replay = Replay::new(LAYOUT, capacity, 1, 1);
            (0..70).for_each(|number| episode(&mut replay, number, 0.5));
            (70..100).for_each(|number| episode(&mut replay, number, 0.3));
            let mut first = motion(0.0);
            first.count(&rule(), &replay);
            (100..149).for_each(|number| episode(&mut replay, number, 0.5));
            let mut resumed = motion(0.0);
            resumed.count(&rule(), &replay);
            assert_eq!(resumed, first);
            assert_eq!(
                first.bonus() > 0.0,
                capacity == 400,
                "70 of 100 moved it, or 20 of the newest 50"
            );
        }
    }

    #[test]
    fn the_newest_segments_are_counted_when_the_ring_is_full() {
        let mut replay = Replay::new(LAYOUT, 400, 1, 1); // 200 slots
        (0..100).for_each(|number| episode(&mut replay, number, 0.5));
        let mut motion = motion(0.0);
        motion.count(&rule(), &replay);
        assert_eq!(motion.bonus(), 0.0);
        (100..150).for_each(|number| episode(&mut replay, number, 0.3));
        motion.count(&rule(), &replay);
        assert_eq!(motion.bonus(), 2.0);
    }

    #[test]
    fn the_share_of_windows_comes_from_episodes_that_moved_the_goal() {
        let mut replay = Replay::new(LAYOUT, 2_000, 1, 1);
        for number in 0..10 {
            episode(&mut replay, number, if number == 3 { 0.5 } else { 0.0 });
        }
        let random = dmprl_shared::seeds::stream(1, "test", 0);
        let mut sampler = Sampler::new(Windows::Sliding, random);
        let motion = motion(0.5);
        let mut draw = || motion.draw(&rule(), &replay, &mut sampler).unwrap();
        let moved = (0..4_000).filter(|_| matches!(draw().slot, 6 | 7)).count();
        // Of half of the windows a tenth; of the other half 1 - 0.9^30. Five standard deviations.
        let expected = 4_000.0 * (0.05 + 0.5 * (1.0 - 0.9_f64.powi(30)));
        assert!((moved as f64 - expected).abs() < 160.0, "{moved} {expected}");
    }

    #[test]
    fn a_step_moves_the_goal_if_it_is_farther_than_a_part_of_the_threshold() {
        let mut replay = Replay::new(LAYOUT, 20, 1, 1);
        episode(&mut replay, 0, 0.05);
        let window = replay.window(0, 1).unwrap();
        let moves = |step| motion(0.0).step_moves(&rule(), &replay, &window, step);
        assert_eq!([moves(1), moves(2)], [true, false]);
    }

    #[test]
    fn dense_rewards_have_no_threshold_and_no_remedies() {
        let dense = GoalRule { reward: GoalReward::Dense { factor: -1.0 }, ..rule() };
        assert_eq!(Motion::new(&dense, 0.5, 1.0), None);
        assert_eq!(Motion::new(&rule(), 0.0, 0.0), None);
    }
}
