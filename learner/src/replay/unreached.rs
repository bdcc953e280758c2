//! Coordinates of the goal that the task asks for and the policy does not reach, such as the height
//! of a cube that it pushes and never lifts.
//!
//! A goal is *away* in a coordinate if it is outside the range in which episodes start. A
//! coordinate is unreached if many desired goals are away in it, and few episodes end there. Two
//! remedies, which are our own:
//! 1. Windows are drawn from the episodes that went away in it, even if there are only a few.
//! 2. Steps that end there get the bonus for motion, once motion itself no longer has it.
//!
//! Both end when episodes end there often enough, for all windows at once.

use dmprl_shared::goal_rule::{GoalReward, GoalRule};
use rand::RngExt;

use super::recent::Newest;
use super::region::{self, Region};
use super::{Replay, Sampler, Window};

/// A goal is away if it is more than this many thresholds outside the range of the starts.
const MARGIN: f32 = 0.4;
/// Share of the desired goals that must be away.
const MANY: f64 = 0.1;
/// Share of the episodes below which few end away, relative to that of the desired goals.
const FEW: f64 = 0.3;
/// Number of newest segments among which those that went away are searched, and of demonstrated
/// ones.
const SEARCHED_SEGMENTS: usize = 50_000;
/// Draws after which a window is taken from another episode.
const DRAWS_MAX: usize = 20;

/// A coordinate of the goal, with the range outside which it is away.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Coordinate {
    index: usize,
    low: f32,
    high: f32,
}

impl Coordinate {
    /// Returns whether a goal, (G,), is away.
    fn is_away(self, goal: &[f32]) -> bool {
        !(self.low..=self.high).contains(&goal[self.index])
    }
}

/// The unreached coordinates, and the segments that went away in them.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Unreached {
    coordinates: Vec<Coordinate>,
    /// Slots of segments that end away, within the region, newest first; then demonstrations.
    slots: Vec<u32>,
}

impl Unreached {
    /// Finds the coordinates from the newest episodes, and the segments that went away.
    pub(super) fn new(rule: &GoalRule, region: &Region, replay: &Replay, newest: &Newest) -> Self {
        let GoalReward::Sparse { threshold, .. } = rule.reward else { return Self::default() };
        let mut starts = Vec::new();
        for &slot in newest.slots.iter().filter(|&&slot| replay.rank(slot) == 0) {
            region::widen(&mut starts, rule.achieved(replay.observation_row(slot, 0)));
        }
        let margin = MARGIN * threshold as f32;
        let coordinates = starts.iter().enumerate().map(|(index, range)| Coordinate {
            index,
            low: range[0] - margin,
            high: range[1] + margin,
        });
        let ends = &newest.ends;
        let coordinates = coordinates.filter(|&coordinate| {
            let desired =
                |&&slot: &&u32| coordinate.is_away(rule.desired(replay.observation_row(slot, 0)));
            let achieved = |&&slot: &&u32| {
                let goal = rule.achieved(replay.last_row(slot));
                coordinate.is_away(goal) && region.contains(goal)
            };
            let asked = ends.iter().filter(desired).count() as f64;
            let reached = ends.iter().filter(achieved).count() as f64;
            // Coordinates that the reward ignores are not part of the task.
            rule.components.contains(&coordinate.index)
                && asked > MANY * ends.len() as f64
                && reached < FEW * asked
        });
        let mut unreached = Self { coordinates: coordinates.collect(), slots: Vec::new() };
        if unreached.any() {
            let is_away =
                |&slot: &u32| unreached.contains(region, rule.achieved(replay.last_row(slot)));
            let demonstrated = (0..replay.demonstrations as u32).take(SEARCHED_SEGMENTS);
            let searched = newest.all(replay).take(SEARCHED_SEGMENTS).chain(demonstrated);
            unreached.slots = searched.filter(is_away).collect();
        }
        unreached
    }

    /// Returns whether there is an unreached coordinate.
    pub(super) fn any(&self) -> bool {
        !self.coordinates.is_empty()
    }

    /// Returns whether a goal, (G,), is away in an unreached coordinate, within the region.
    pub(super) fn contains(&self, region: &Region, goal: &[f32]) -> bool {
        self.coordinates.iter().any(|&coordinate| coordinate.is_away(goal)) && region.contains(goal)
    }

    /// Draws a window from an episode that went away, or returns `None` if there is none.
    pub(super) fn draw(&self, replay: &Replay, sampler: &mut Sampler) -> Option<Window> {
        if self.slots.is_empty() {
            return None;
        }
        (0..DRAWS_MAX).find_map(|_| {
            let random = sampler.random_mut();
            let live = replay.live(self.slots[random.random_range(0..self.slots.len())]);
            let rank = random.random_range(live.first_rank..=live.last_rank);
            let slot = replay.slot_at(live.newest, rank)?;
            sampler.draw_in(replay, slot as usize)
        })
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use dmprl_shared::config::Windows;
    use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TRUNCATED};

    use super::super::recent::Recent;
    use super::*;
    use crate::learner::tests::goal_rule;

    /// Observations are (achieved goal, desired goal).
    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 1, observation_len: 2, action_len: 1 };

    fn rule() -> GoalRule {
        let reward = GoalReward::Sparse { threshold: 1.0, reached: 0.0, missed: -1.0 };
        GoalRule { reward, ..goal_rule() }
    }

    /// Inserts episodes of two segments that start at 0, go to `middle`, and end at `end`.
    fn insert(replay: &mut Replay, episodes: impl IntoIterator<Item = Episode>) {
        for Episode { number, middle, end, desired } in episodes {
            for (step, [before, after]) in [[0.0, middle], [middle, end]].into_iter().enumerate() {
                let header = SegmentHeader {
                    episode: number,
                    episode_step: step as u32,
                    steps_len: 1,
                    flags: if step == 1 { TRUNCATED } else { 0 },
                    ..SegmentHeader::default()
                };
                replay.insert(&header, &[before, desired, after, desired, 0.1, -1.0]);
            }
        }
    }

    struct Episode {
        number: u32,
        middle: f32,
        end: f32,
        desired: f32,
    }

    /// Makes 100 episodes.
    fn replay(episode: impl Fn(u32) -> [f32; 3]) -> Replay {
        let mut replay = Replay::new(LAYOUT, 1_000, 1, 1);
        insert(&mut replay, numbered(0..100, episode));
        replay
    }

    /// Makes episodes from (middle, end, desired) of each number.
    fn numbered(
        numbers: Range<u32>,
        episode: impl Fn(u32) -> [f32; 3],
    ) -> impl Iterator<Item = Episode> {
        numbers.map(move |number| {
            let [middle, end, desired] = episode(number);
            Episode { number, middle, end, desired }
        })
    }

    fn unreached(replay: &Replay) -> Unreached {
        let newest = Recent::default().read(replay).unwrap();
        let region = Region::new(&rule(), replay, &newest.slots);
        Unreached::new(&rule(), &region, replay, &newest)
    }

    #[test]
    fn a_coordinate_is_unreached_while_the_task_asks_for_it_and_few_episodes_end_there() {
        // Of 100 episodes 20 shall go to 5, so fewer than 6 that end there are few.
        let is_unreached = |count, end| {
            let desired = |number| if number < 20 { 5.0 } else { 0.0 };
            unreached(&replay(|number| {
                [0.0, if number < count { end } else { 0.0 }, desired(number)]
            }))
            .any()
        };
        assert!(is_unreached(0, 5.0) && is_unreached(5, 5.0));
        assert!(!is_unreached(6, 5.0));
        assert!(is_unreached(6, 0.4), "within the margin");
        assert!(is_unreached(6, 50.0), "not in the region");
        let comes_back = replay(|_| [5.0, 0.0, 5.0]);
        assert!(unreached(&comes_back).any(), "episodes do not end there");
        let seldom = replay(|number| [0.0, 0.0, if number < 10 { 5.0 } else { 0.0 }]);
        assert!(!unreached(&seldom).any(), "hardly asked for");
        assert!(!Unreached::default().any());
    }

    #[test]
    fn coordinates_that_the_reward_ignores_are_not_unreached() {
        let replay = replay(|_| [0.0, 0.0, 5.0]);
        let newest = Recent::default().read(&replay).unwrap();
        let ignoring = GoalRule { components: Vec::new(), ..rule() };
        let region = Region::default();
        assert!(!Unreached::new(&ignoring, &region, &replay, &newest).any());
    }

    #[test]
    fn windows_are_drawn_from_all_segments_of_the_episodes_that_went_away() {
        let replay = replay(|number| [if number == 7 { 4.0 } else { 0.0 }, 0.0, 5.0]);
        let random = dmprl_shared::seeds::stream(1, "test", 0);
        let mut sampler = Sampler::new(Windows::Sliding, random);
        let unreached = unreached(&replay);
        assert_eq!(unreached.slots, [14]);
        let mut drawn = [0; 2];
        for _ in 0..200 {
            let window = unreached.draw(&replay, &mut sampler).unwrap();
            drawn[window.slot as usize - 14] += 1;
        }
        assert!(drawn[0] > 60 && drawn[1] > 60, "{drawn:?}");
        assert_eq!(Unreached::default().draw(&replay, &mut sampler), None);
    }

    #[test]
    fn demonstrations_that_went_away_are_drawn_and_do_not_count_as_reached() {
        let mut replay = Replay::new(LAYOUT, 1_000, 1, 1);
        for (step, after) in [0.0, 4.0].into_iter().enumerate() {
            let header = SegmentHeader {
                episode_step: step as u32,
                steps_len: 1,
                flags: if step == 1 { TRUNCATED } else { 0 },
                ..SegmentHeader::default()
            };
            replay.insert_demonstration(&header, &[0.0, 5.0, after, 5.0, 0.1, -1.0]);
        }
        assert!(Recent::default().read(&replay).unwrap().slots.is_empty());
        insert(
            &mut replay,
            numbered(0..50, |number| [if number == 7 { 4.0 } else { 0.0 }, 0.0, 5.0]),
        );
        let unreached = unreached(&replay);
        assert_eq!(unreached.slots, [16, 1]);
        let random = dmprl_shared::seeds::stream(1, "test", 0);
        let mut sampler = Sampler::new(Windows::Sliding, random);
        let drawn = (0..200).map(|_| unreached.draw(&replay, &mut sampler).unwrap().slot);
        assert!(drawn.filter(|&slot| slot < 2).count() > 60);
    }

    #[test]
    fn a_reading_that_is_made_later_is_the_same() {
        // In the smaller ring the later episodes replace some of the first ones.
        for capacity in [1_000, 250] {
            let mut replay = Replay::new(LAYOUT, capacity, 1, 1);
            let episode = |number| [if number % 9 == 0 { 4.0 } else { 0.0 }, 0.0, 5.0];
            insert(&mut replay, numbered(0..100, episode));
            let first = unreached(&replay);
            insert(&mut replay, numbered(100..149, episode));
            assert!(first.slots.len() > 3);
            assert_eq!(unreached(&replay), first);
        }
    }

    #[test]
    fn only_goals_in_the_region_that_are_away_are_contained() {
        let replay = replay(|_| [0.0, 0.0, 5.0]);
        let region = Region::new(&rule(), &replay, &[0, 1]);
        let contains = |goal| unreached(&replay).contains(&region, &[goal]);
        assert_eq!([0.3, 0.5, 5.9, 6.1].map(contains), [false, true, true, false]);
    }
}
