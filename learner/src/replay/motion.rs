//! Motion of the achieved goal, such as that of an object to push.
//!
//! Random actions rarely touch an object, so most windows come from episodes in which it did not
//! move, and the learner cannot learn from them how to move it. Two remedies, which are our own:
//! 1. A share of the windows comes from episodes that moved the achieved goal.
//! 2. A step that moves it gets a bonus while fewer than half of the recent episodes moved it. The
//!    bonus is added when a batch is sampled, so it starts and ends for all windows at once.
//!
//! If the policy does not reach a coordinate that the task asks for ([`super::unreached`]), half of
//! that share and, once many episodes move the goal, the bonus are for this coordinate.
//!
//! Windows and bonus are for motion within the region of the task ([`super::region`]), because a
//! policy that strikes an object as far as it can has not learned to place it.

use dmprl_shared::goal_rule::{GoalReward, GoalRule};

use super::recent::Newest;
use super::region::Region;
use super::unreached::Unreached;
use super::{Replay, Sampler, Window};

/// An episode moves the achieved goal if its end is farther from its start than this many
/// thresholds of the goal.
const EPISODE_MOVES: f64 = 0.4;
/// A step moves the achieved goal if it does so by more than this many thresholds.
const STEP_MOVES: f64 = 0.04;
/// Share of the recent episodes below which steps get a bonus, and from which on workers explore
/// less.
const RARE: f64 = 0.5;
/// Share of these windows that come from episodes that went away in an unreached coordinate.
const UNREACHED_SHARE: f64 = 0.5;
/// Draws after which a window is taken from any episode.
const DRAWS_MAX: usize = 30;

/// Prefers and rewards motion, with a sparse reward. Its threshold is the unit of distances.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Motion {
    threshold: f64,
    /// Share of the windows from episodes that moved the achieved goal.
    share: f64,
    unreached: Unreached,
    /// Reward of a step that moves the achieved goal, while few episodes do.
    bonus: f32,
    /// Share of the recent episodes that moved the achieved goal; `None` before any has ended.
    moving: Option<f64>,
}

impl Motion {
    /// Makes the remedies for a rule. `factor` is the bonus, in units of the difference between a
    /// reached goal's reward and a missed one's. Returns `None` if the reward is dense.
    pub(super) fn new(rule: &GoalRule, share: f64, factor: f64) -> Option<Self> {
        let GoalReward::Sparse { threshold, reached, missed } = rule.reward else { return None };
        let bonus = (factor * (reached - missed)) as f32;
        let unreached = Unreached::default();
        Some(Self { threshold, share, unreached, bonus, moving: None })
    }

    /// Counts the newest episodes, and finds unreached coordinates.
    pub(super) fn read(
        &mut self,
        rule: &GoalRule,
        region: &Region,
        replay: &Replay,
        newest: &Newest,
    ) {
        let moved = |&&slot: &&u32| self.moved(rule, replay, slot).is_some();
        let count = newest.ends.iter().filter(moved).count();
        self.moving = (!newest.ends.is_empty()).then(|| count as f64 / newest.ends.len() as f64);
        self.unreached = Unreached::new(rule, region, replay, newest);
    }

    /// Returns the bonus of a step that [`Self::has_bonus`], or 0 if no step has it.
    pub(super) fn bonus(&self) -> f32 {
        let is_due = if self.is_settled() { self.unreached.any() } else { self.moving.is_some() };
        if is_due { self.bonus } else { 0.0 }
    }

    /// Returns whether many recent episodes moved the achieved goal.
    pub(super) fn is_settled(&self) -> bool {
        self.moving.is_some_and(|share| share >= RARE)
    }

    /// Draws a window, with probability `share` from an episode that moved the achieved goal and
    /// ended in the region. While a coordinate is unreached, half of these windows are from
    /// episodes that went away in it.
    pub(super) fn draw(
        &self,
        rule: &GoalRule,
        region: &Region,
        replay: &Replay,
        sampler: &mut Sampler,
    ) -> Option<Window> {
        let mut window = sampler.draw(replay)?;
        if !sampler.flip(self.share) {
            return Some(window);
        }
        if self.unreached.any()
            && sampler.flip(UNREACHED_SHARE)
            && let Some(reaching) = self.unreached.draw(replay, sampler)
        {
            return Some(reaching);
        }
        for _ in 1..DRAWS_MAX {
            if self.moved(rule, replay, window.slot).is_some_and(|end| region.contains(end)) {
                break;
            }
            window = sampler.draw(replay)?;
        }
        Some(window)
    }

    /// Returns where the live part of an episode ends, if that is far from where it began.
    fn moved<'a>(&self, rule: &GoalRule, replay: &'a Replay, slot: u32) -> Option<&'a [f32]> {
        let live = replay.live(slot);
        let first = replay.slot_at(live.newest, live.first_rank)?;
        let start = rule.achieved(replay.observation_row(first, 0));
        let end = rule.achieved(replay.last_row(live.newest));
        (rule.distance(start, end) > EPISODE_MOVES * self.threshold).then_some(end)
    }

    /// Returns whether step `step` of a window, counted from 1, gets the bonus: it moves the
    /// achieved goal and leaves it in the region. Once many episodes move it, the step must leave
    /// it away in an unreached coordinate instead.
    pub(super) fn has_bonus(
        &self,
        rule: &GoalRule,
        region: &Region,
        replay: &Replay,
        window: &Window,
        step: usize,
    ) -> bool {
        let after = rule.achieved(replay.observation_after(window, step));
        if self.is_settled() {
            return self.unreached.contains(region, after);
        }
        let before = rule.achieved(replay.observation_after(window, step - 1));
        rule.distance(before, after) > STEP_MOVES * self.threshold && region.contains(after)
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Windows;
    use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TRUNCATED};

    use super::super::recent::Recent;
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
        episode_with_goal(replay, number, step, 0.3);
    }

    fn episode_with_goal(replay: &mut Replay, number: u32, step: f32, goal: f32) {
        let first = [0.0, goal, 0.0, goal, step, goal, 0.1, 0.2, -2.0, -2.0];
        let second = [step, goal, step, goal, step, goal, 0.1, 0.2, -2.0, -2.0];
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

    /// Counts the recent episodes, if that is due.
    fn count(motion: &mut Motion, recent: &mut Recent, replay: &Replay) {
        if let Some(newest) = recent.read(replay) {
            motion.read(&rule(), &Region::default(), replay, &newest);
        }
    }

    #[test]
    fn steps_get_a_bonus_only_while_few_recent_episodes_move_the_goal() {
        let mut replay = Replay::new(LAYOUT, 2_000, 1, 1);
        let (mut motion, mut recent) = (motion(0.0), Recent::default());
        count(&mut motion, &mut recent, &replay);
        assert_eq!((motion.bonus(), motion.is_settled()), (0.0, false), "no episode has ended");
        for number in 0..50 {
            episode(&mut replay, number, if number < 24 { 0.5 } else { 0.3 });
        }
        count(&mut motion, &mut recent, &replay);
        assert_eq!((motion.bonus(), motion.is_settled()), (2.0, false), "24 of 50");
        episode(&mut replay, 50, 0.5);
        count(&mut motion, &mut recent, &replay);
        assert_eq!(motion.bonus(), 2.0, "the next count is due after 100 segments");
        for number in 51..100 {
            episode(&mut replay, number, 0.5);
        }
        count(&mut motion, &mut recent, &replay);
        assert_eq!((motion.bonus(), motion.is_settled()), (0.0, true), "74 of 100");
    }

    #[test]
    fn a_count_that_is_made_later_is_the_same() {
        // In the smaller ring the later episodes replace some of the first ones.
        for capacity in [2_000, 400] {
            let mut replay = Replay::new(LAYOUT, capacity, 1, 1);
            (0..70).for_each(|number| episode(&mut replay, number, 0.5));
            (70..100).for_each(|number| episode(&mut replay, number, 0.3));
            let mut first = motion(0.0);
            count(&mut first, &mut Recent::default(), &replay);
            (100..149).for_each(|number| episode(&mut replay, number, 0.5));
            let mut resumed = motion(0.0);
            count(&mut resumed, &mut Recent::default(), &replay);
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
        let (mut motion, mut recent) = (motion(0.0), Recent::default());
        count(&mut motion, &mut recent, &replay);
        assert_eq!(motion.bonus(), 0.0);
        (100..150).for_each(|number| episode(&mut replay, number, 0.3));
        count(&mut motion, &mut recent, &replay);
        assert_eq!(motion.bonus(), 2.0);
    }

    #[test]
    fn the_share_of_windows_comes_from_episodes_that_moved_the_goal_within_the_region() {
        let mut replay = Replay::new(LAYOUT, 2_000, 1, 1);
        for number in 0..10 {
            let step = [0.0, 0.0, 20.0, 0.5, 0.0, 0.0, 20.0, 0.0, 0.0, 0.0][number as usize];
            episode(&mut replay, number, step);
        }
        let random = dmprl_shared::seeds::stream(1, "test", 0);
        let mut sampler = Sampler::new(Windows::Sliding, random);
        let (motion, region) = (motion(0.5), region(&replay));
        let mut draw = || motion.draw(&rule(), &region, &replay, &mut sampler).unwrap();
        let moved = (0..4_000).filter(|_| matches!(draw().slot, 6 | 7)).count();
        // Of half of the windows a tenth; of the other half 1 - 0.9^30. Five standard deviations.
        let expected = 4_000.0 * (0.05 + 0.5 * (1.0 - 0.9_f64.powi(30)));
        assert!((moved as f64 - expected).abs() < 160.0, "{moved} {expected}");
    }

    #[test]
    fn a_step_moves_the_goal_if_it_is_farther_than_a_part_of_the_threshold_and_in_the_region() {
        let mut replay = Replay::new(LAYOUT, 20, 1, 1);
        episode(&mut replay, 0, 0.05);
        episode(&mut replay, 1, 20.0);
        let region = region(&replay);
        let moves = |slot, step| {
            let window = replay.window(slot, 1).unwrap();
            motion(0.0).has_bonus(&rule(), &region, &replay, &window, step)
        };
        assert_eq!([moves(0, 1), moves(0, 2), moves(2, 1)], [true, false, false]);
    }

    /// Returns the region of all segments: 0 to 0.3 and a threshold more.
    fn region(replay: &Replay) -> Region {
        let slots: Vec<u32> = (0..replay.len() as u32).collect();
        Region::new(&rule(), replay, &slots)
    }

    #[test]
    fn once_episodes_move_the_goal_an_unreached_coordinate_has_the_bonus_and_half_of_the_share() {
        // All episodes shall go to 3 and end away, at 2 or, most of them, on the other side of the
        // region. A fifth is too few.
        let mut replay = Replay::new(LAYOUT, 2_000, 1, 1);
        let reaches = |number| number % 5 == 0;
        for number in 0..100 {
            episode_with_goal(&mut replay, number, if reaches(number) { 2.0 } else { -20.0 }, 3.0);
        }
        let mut motion = motion(1.0);
        let newest = Recent::default().read(&replay).unwrap();
        let region = Region::new(&rule(), &replay, &newest.slots);
        motion.read(&rule(), &region, &replay, &newest);
        assert_eq!((motion.is_settled(), motion.bonus()), (true, 2.0));
        let has_bonus = |slot, offset, step| {
            let window = replay.window(slot, offset).unwrap();
            motion.has_bonus(&rule(), &region, &replay, &window, step)
        };
        // Also a step that does not move it; not one before it is away, or outside of the region.
        let away = [has_bonus(0, 0, 2), has_bonus(1, 0, 1)];
        assert_eq!((away, has_bonus(0, 0, 1), has_bonus(2, 0, 2)), ([true; 2], false, false));
        // Half of the windows, and of the other half those that 30 draws find.
        let random = dmprl_shared::seeds::stream(1, "test", 0);
        let mut sampler = Sampler::new(Windows::Segment, random);
        let mut draw = || motion.draw(&rule(), &region, &replay, &mut sampler).unwrap();
        assert!((0..500).filter(|_| reaches(draw().slot / 2)).count() > 480);
        // When all of them reach it, nothing is left of it.
        for number in 100..200 {
            episode_with_goal(&mut replay, number, 2.0, 3.0);
        }
        let newest = Recent::default().read(&replay).unwrap();
        motion.read(&rule(), &region, &replay, &newest);
        assert_eq!((motion.is_settled(), motion.bonus()), (true, 0.0));
    }

    #[test]
    fn dense_rewards_have_no_threshold() {
        let dense = GoalRule { reward: GoalReward::Dense { factor: -1.0 }, ..rule() };
        assert_eq!(Motion::new(&dense, 0.5, 1.0), None);
    }
}
