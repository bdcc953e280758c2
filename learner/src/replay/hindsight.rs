//! Hindsight when a batch is sampled: a window gets another goal, which its episode reached
//! (Andrychowicz et al. 2017), and the rewards for that goal, from the environment's goal rule.
//!
//! Differences from Andrychowicz et al., Algorithm 1:
//! 1. Goals are drawn anew for each sample, as in their code; the replay keeps each step once.
//! 2. A goal is drawn for a window of K steps; K = 1 is the published algorithm.
//! 3. If the task ends episodes at the goal, a window ends at its first step that reaches the new
//!    goal. A window that is short only because the episode's own goal ended it keeps that goal,
//!    because a missing action is not a zero action.
//! 4. Goals in the region of the task are preferred ([`super::region`]).
//! 5. Some goals are the desired goals of other episodes (`replay.other_goals_share`).
//! 6. Some reached goals are moved, so that the window misses them (`replay.near_misses_share`).

use dmprl_shared::config::{ExperimentConfig, Hindsight};
use dmprl_shared::goal_rule::GoalRule;
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::motion::Motion;
use super::recent::Recent;
use super::region::Region;
use super::{Replay, Sampler, Window};

/// Draws after which a goal outside the region is taken.
const DRAWS_MAX: usize = 8;

/// Draws goals for windows.
#[derive(Debug, Clone)]
pub struct GoalSampler {
    /// The environment's rule.
    pub rule: GoalRule,
    strategy: Hindsight,
    /// Share of the windows that get another goal.
    share: f64,
    /// Share of these whose goal is the desired one of another episode.
    other_share: f64,
    /// Share of the reached goals that are moved.
    near_share: f64,
    motion: Option<Motion>,
    region: Region,
    recent: Recent,
}

/// A goal in place of a window's own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Goal<'a> {
    /// The environment's rule.
    pub rule: &'a GoalRule,
    /// The goal, (G,).
    pub values: &'a [f32],
}

/// The part of a window that is a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outcome {
    /// Number of steps n, 1 to K.
    pub steps: usize,
    /// Whether the episode ends at the last of them.
    pub terminated: bool,
}

impl GoalSampler {
    /// Makes the configured sampler, or returns `None` without hindsight.
    #[must_use]
    pub fn from_config(rule: Option<&GoalRule>, config: &ExperimentConfig) -> Option<Self> {
        let replay = &config.replay;
        let sampler = Self::new(rule, replay.hindsight, replay.hindsight_share)?;
        let bonus = config.algorithm.motion_bonus;
        let motion = Motion::new(&sampler.rule, replay.moved_share, bonus);
        let (other_share, near_share) = (replay.other_goals_share, replay.near_misses_share);
        Some(Self { motion, other_share, near_share, ..sampler })
    }

    /// Makes a sampler of goals that a window's own episode reached, without regard to motion, or
    /// returns `None` without hindsight.
    #[must_use]
    pub fn new(rule: Option<&GoalRule>, strategy: Hindsight, share: f64) -> Option<Self> {
        let rule = rule.filter(|_| strategy != Hindsight::None)?;
        let (region, recent) = (Region::default(), Recent::default());
        let (rule, motion) = (rule.clone(), None);
        let (other_share, near_share) = (0.0, 0.0);
        Some(Self { rule, strategy, share, other_share, near_share, motion, region, recent })
    }

    /// Finds the task's region and counts motion in the recent episodes, if that is due. Call it
    /// before a batch is sampled.
    pub fn read_recent(&mut self, replay: &Replay) {
        let Some(newest) = self.recent.read(replay) else { return };
        self.region = Region::new(&self.rule, replay, &newest.slots);
        if let Some(motion) = &mut self.motion {
            motion.read(&self.rule, &self.region, replay, &newest);
        }
    }

    /// Returns whether most recent episodes move the achieved goal.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.motion.as_ref().is_some_and(Motion::is_settled)
    }

    /// Draws a window, preferably from an episode that moved the achieved goal, as configured.
    pub fn draw_window(&self, replay: &Replay, sampler: &mut Sampler) -> Option<Window> {
        match &self.motion {
            Some(motion) => motion.draw(&self.rule, &self.region, replay, sampler),
            None => sampler.draw(replay),
        }
    }

    /// Returns the sum of discount^i b_i over the first `steps` steps of a window, where b_i is the
    /// bonus of step i.
    #[must_use]
    pub fn discounted_bonus(
        &self,
        replay: &Replay,
        window: &Window,
        steps: usize,
        discount: f32,
    ) -> f32 {
        let Some(motion) = self.motion.as_ref().filter(|motion| motion.bonus() > 0.0) else {
            return 0.0;
        };
        (1..=steps).rev().fold(0.0, |sum, step| {
            let gets = motion.has_bonus(&self.rule, &self.region, replay, window, step);
            discount * sum + if gets { motion.bonus() } else { 0.0 }
        })
    }

    /// Returns the range of the returns that the rewards allow, or `None` if it is unbounded.
    #[must_use]
    pub fn return_range(&self, discount: f64) -> Option<[f32; 2]> {
        let [low, high] = self.rule.return_range(discount)?;
        let bonus = self.motion.as_ref().map_or(0.0, Motion::bonus);
        Some([low, high + (f64::from(bonus) / (1.0 - discount)) as f32])
    }

    /// Draws a goal for a window, in the region if one of some draws is. Returns `None` if the
    /// window keeps its own.
    ///
    /// Steps of the episode that have not arrived, or have been replaced, are not drawn. `buffer`
    /// keeps a goal that nothing in the replay has.
    pub fn draw<'a>(
        &'a self,
        replay: &'a Replay,
        window: &Window,
        random: &mut Xoshiro256PlusPlus,
        buffer: &'a mut Vec<f32>,
    ) -> Option<Goal<'a>> {
        if !random.random_bool(self.share) || replay.slots[window.slot as usize].hindsight {
            return None;
        }
        let rule = &self.rule;
        if self.other_share > 0.0 && random.random_bool(self.other_share) {
            let other = random.random_range(0..replay.filled) as u32;
            return Some(Goal { rule, values: rule.desired(replay.observation_row(other, 0)) });
        }
        let reached = self.draw_reached(replay, window, random)?;
        if self.near_share == 0.0 || !random.random_bool(self.near_share) {
            return Some(Goal { rule, values: reached });
        }
        self.write_near_miss(replay, reached, random, buffer);
        Some(Goal { rule, values: buffer })
    }

    /// Writes a reached goal, moved by a random part of the way by which another episode of the
    /// replay has missed its goal so far.
    fn write_near_miss(
        &self,
        replay: &Replay,
        reached: &[f32],
        random: &mut Xoshiro256PlusPlus,
        out: &mut Vec<f32>,
    ) {
        let other = random.random_range(0..replay.filled) as u32;
        let last = replay.last_row(replay.live(other).newest);
        let part = random.random::<f32>();
        let way = self.rule.desired(last).iter().zip(self.rule.achieved(last));
        let moved =
            reached.iter().zip(way).map(|(reached, (to, from))| reached + part * (to - from));
        out.clear();
        out.extend(moved);
    }

    /// Draws a goal that the window's episode reached.
    fn draw_reached<'a>(
        &self,
        replay: &'a Replay,
        window: &Window,
        random: &mut Xoshiro256PlusPlus,
    ) -> Option<&'a [f32]> {
        let steps_max = replay.layout.segment_steps;
        let live = replay.live(window.slot);
        // Steps of the episode, counted from the oldest live segment. All segments but the last
        // have K steps.
        let first = (replay.rank(window.slot) - live.first_rank) as usize * steps_max
            + usize::from(window.offset);
        let end = (live.last_rank - live.first_rank) as usize * steps_max
            + usize::from(replay.slots[live.newest as usize].steps_len);
        let draws_max = if self.strategy == Hindsight::Final { 1 } else { DRAWS_MAX };
        let mut drawn = None;
        for _ in 0..draws_max {
            let step = match self.strategy {
                Hindsight::Final => end,
                Hindsight::Episode => random.random_range(1..=end),
                _ => random.random_range(first + 1..=end.max(first + 1)),
            };
            let rank = live.first_rank + ((step - 1) / steps_max) as u32;
            let slot = replay.slot_at(live.newest, rank)?;
            let row = (step - 1) % steps_max + 1;
            let reached = self.rule.achieved(replay.observation_row(slot, row));
            drawn = Some(reached);
            if self.region.contains(reached) {
                break;
            }
        }
        drawn
    }
}

impl Replay {
    /// Returns the outcome of a window with another goal, or `None` if the window cannot have it.
    #[must_use]
    pub fn outcome(&self, window: &Window, goal: Goal<'_>) -> Option<Outcome> {
        let rule = goal.rule;
        let reaches = |steps: &usize| rule.ends(self.goal_distance(window, *steps, goal));
        if let Some(steps) = (1..=window.len()).find(reaches) {
            return Some(Outcome { steps, terminated: true });
        }
        let steps = window.len();
        let last = self.observation_after(window, steps);
        // An end that is not due to the episode's own goal remains.
        let by_goal = rule.ends(rule.distance(rule.achieved(last), rule.desired(last)));
        let terminated = window.terminated && !by_goal;
        let is_whole = steps == self.layout.segment_steps;
        (is_whole || terminated).then_some(Outcome { steps, terminated })
    }

    /// Returns the sum of discount^i r_i over the first `steps` steps with another goal.
    #[must_use]
    pub fn discounted_goal_reward(
        &self,
        window: &Window,
        steps: usize,
        goal: Goal<'_>,
        discount: f32,
    ) -> f32 {
        let reward = |step| goal.rule.reward(self.goal_distance(window, step, goal));
        (1..=steps).rev().fold(0.0, |sum, step| reward(step) + discount * sum)
    }

    /// Returns the distance to the goal after `steps` steps of the window.
    pub(super) fn goal_distance(&self, window: &Window, steps: usize, goal: Goal<'_>) -> f64 {
        let Goal { rule, values } = goal;
        rule.distance(rule.achieved(self.observation_after(window, steps)), values)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use dmprl_shared::config::Windows;
    use dmprl_shared::seeds;
    use dmprl_shared::segment::{HINDSIGHT, SegmentHeader, SegmentLayout, TERMINATED, TRUNCATED};

    use super::super::Sampler;
    use super::*;
    use crate::learner::tests::goal_rule;

    /// Observations are (achieved goal, desired goal).
    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 3, observation_len: 2, action_len: 1 };
    const GOAL: f32 = 90.0;

    fn rule(ends_within: Option<f64>) -> GoalRule {
        GoalRule { ends_within, ..goal_rule() }
    }

    fn sampler(strategy: Hindsight, share: f64, ends_within: Option<f64>) -> GoalSampler {
        GoalSampler::new(Some(&rule(ends_within)), strategy, share).unwrap()
    }

    /// Inserts an episode that achieves `start + t` in step t, in segments of environment `env`.
    fn episode(replay: &mut Replay, start: f32, steps: u32, flag: u32) {
        for first in (0..steps).step_by(3) {
            let len = (steps - first).min(3);
            let mut block = vec![0.0; LAYOUT.block_len()];
            let (observations, actions, rewards) = LAYOUT.split_mut(&mut block);
            for k in 0..=len {
                let row = &mut observations[2 * k as usize..2 * k as usize + 2];
                row.copy_from_slice(&[start + (first + k) as f32, GOAL]);
            }
            actions[..len as usize].fill(0.5);
            rewards[..len as usize].fill(-1.0);
            let header = SegmentHeader {
                episode: start as u32,
                episode_step: first,
                steps_len: len,
                flags: if first + len == steps { flag } else { 0 },
                ..SegmentHeader::default()
            };
            replay.insert(&header, &block);
        }
    }

    /// Draws a goal for a window.
    fn draw(
        replay: &Replay,
        goals: &GoalSampler,
        window: &Window,
        random: &mut Xoshiro256PlusPlus,
    ) -> Option<f32> {
        goals.draw(replay, window, random, &mut Vec::new()).map(|goal| goal.values[0])
    }

    /// Returns the goals that are drawn for the window at step `offset` of `slot`.
    fn drawn(replay: &Replay, goals: &GoalSampler, slot: usize, offset: usize) -> Vec<f32> {
        let window = replay.window(slot, offset).unwrap();
        let mut random = seeds::stream(1, "test", 0);
        let drawn = (0..400).filter_map(|_| draw(replay, goals, &window, &mut random));
        let set: BTreeSet<u32> = drawn.map(|goal| goal as u32).collect();
        set.into_iter().map(|goal| goal as f32).collect()
    }

    fn goals_from(first: u32, last: u32) -> Vec<f32> {
        (first..=last).map(|goal| goal as f32).collect()
    }

    #[test]
    fn each_strategy_draws_from_its_steps_of_the_episode_and_only_of_it() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 10.0, 8, TRUNCATED);
        episode(&mut replay, 30.0, 7, TRUNCATED);
        let goals = |strategy| drawn(&replay, &sampler(strategy, 1.0, None), 1, 1);
        // The window at step 4 achieves 15 first; the episode ends at 18.
        assert_eq!(goals(Hindsight::Future), goals_from(15, 18));
        assert_eq!(goals(Hindsight::Final), [18.0]);
        assert_eq!(goals(Hindsight::Episode), goals_from(11, 18));
    }

    #[test]
    fn an_unfinished_episode_gives_the_goals_that_have_arrived() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 10.0, 6, 0);
        let goals = sampler(Hindsight::Future, 1.0, None);
        assert_eq!(drawn(&replay, &goals, 0, 0), goals_from(11, 16));
    }

    #[test]
    fn replaced_steps_are_not_drawn() {
        let mut replay = Replay::new(LAYOUT, 12, 1, 1); // 4 slots
        episode(&mut replay, 10.0, 9, TRUNCATED);
        episode(&mut replay, 30.0, 9, TRUNCATED); // replaces the first two slots of the former
        let goals = sampler(Hindsight::Episode, 1.0, None);
        assert_eq!(drawn(&replay, &goals, 2, 0), goals_from(17, 19));
        assert_eq!(drawn(&replay, &goals, 0, 1), goals_from(31, 39));
    }

    #[test]
    fn goals_in_the_region_are_preferred_and_others_are_taken_where_there_is_none() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 86.0, 9, TRUNCATED); // the region ends near the desired goal, 90
        let mut goals = sampler(Hindsight::Future, 1.0, None);
        goals.region = Region::new(&goals.rule, &replay, &[0, 1, 2]);
        let mut counts = [0; 10];
        let window = replay.window(0, 0).unwrap();
        let mut random = seeds::stream(1, "test", 0);
        for _ in 0..20_000 {
            let goal = draw(&replay, &goals, &window, &mut random).unwrap();
            counts[goal as usize - 86] += 1;
        }
        // Four of nine goals are in the region; eight draws miss it with (5/9)^8 = 0.009.
        assert!(counts[1..=4].iter().all(|&count| count > 4_500), "{counts:?}");
        assert!((100..300).contains(&counts[5..].iter().sum::<u32>()), "{counts:?}");
        assert_eq!(drawn(&replay, &goals, 2, 0), goals_from(93, 95));
    }

    #[test]
    fn a_share_of_the_goals_are_desired_goals_of_other_episodes() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 10.0, 6, TRUNCATED);
        let mut goals = sampler(Hindsight::Final, 1.0, None);
        goals.other_share = 0.3;
        assert_eq!(drawn(&replay, &goals, 0, 1), [16.0, GOAL]);
        let (window, mut random) = (replay.window(0, 1).unwrap(), seeds::stream(1, "test", 0));
        let draws = (0..10_000).map(|_| draw(&replay, &goals, &window, &mut random).unwrap());
        let count = draws.filter(|&goal| goal == GOAL).count();
        // Binomial(10000, 0.3) has standard deviation 46; five of them are allowed.
        assert!(count.abs_diff(3_000) < 230, "{count}");
    }

    #[test]
    fn a_share_of_the_reached_goals_is_moved_as_far_as_other_episodes_missed_theirs() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 10.0, 6, TRUNCATED); // misses its goal by 74
        episode(&mut replay, 70.0, 6, 0); // by 14 so far
        let mut goals = sampler(Hindsight::Final, 1.0, None);
        goals.near_share = 0.4;
        let (window, mut random) = (replay.window(0, 1).unwrap(), seeds::stream(1, "test", 0));
        let draws = (0..10_000).map(|_| draw(&replay, &goals, &window, &mut random).unwrap());
        let moved: Vec<f32> = draws.map(|goal| goal - 16.0).filter(|&way| way != 0.0).collect();
        // Binomials: (10000, 0.4) has standard deviation 49; half of the 4000 moves, and 14/74 of
        // the other half, are at most 14 long, with 31. Five standard deviations are allowed.
        assert!(moved.len().abs_diff(4_000) < 245, "{}", moved.len());
        assert!(moved.iter().all(|way| (0.0..=74.0).contains(way)));
        let short = moved.iter().filter(|&&way| way <= 14.0).count();
        let expected = (0.5 + 0.5 * 14.0 / 74.0) * moved.len() as f64;
        assert!((short as f64 - expected).abs() < 160.0, "{short} {expected}");
    }

    #[test]
    fn the_configured_shares_reach_the_sampler() {
        let mut config = ExperimentConfig::default();
        config.replay.hindsight = Hindsight::Future;
        (config.replay.other_goals_share, config.replay.near_misses_share) = (0.1, 0.2);
        let goals = GoalSampler::from_config(Some(&rule(None)), &config).unwrap();
        assert_eq!((goals.other_share, goals.near_share), (0.1, 0.2));
    }

    #[test]
    fn share_and_copies_of_workers_are_respected() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 10.0, 6, TRUNCATED);
        let window = replay.window(0, 1).unwrap();
        let goals = sampler(Hindsight::Future, 0.8, None);
        let mut random = seeds::stream(1, "test", 0);
        let count =
            (0..10_000).filter(|_| draw(&replay, &goals, &window, &mut random).is_some()).count();
        // Binomial(10000, 0.8) has standard deviation 40; five of them are allowed.
        assert!(count.abs_diff(8_000) < 200, "{count}");
        let header = SegmentHeader { flags: HINDSIGHT, steps_len: 3, ..Default::default() };
        replay.insert(&header, &vec![0.0; LAYOUT.block_len()]);
        assert!(drawn(&replay, &sampler(Hindsight::Final, 1.0, None), 2, 0).is_empty());
    }

    #[test]
    fn rewards_are_those_of_the_new_goal() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 10.0, 6, TRUNCATED);
        let window = replay.window(0, 1).unwrap(); // achieves 12, 13 and 14
        let rule = rule(None);
        let goal = Goal { rule: &rule, values: &[13.0] };
        let outcome = replay.outcome(&window, goal).unwrap();
        assert_eq!(outcome, Outcome { steps: 3, terminated: false });
        // -1 + 0.5 * 0 - 0.25
        assert_eq!(replay.discounted_goal_reward(&window, 3, goal, 0.5), -1.25);
    }

    #[test]
    fn a_window_ends_where_the_task_would_have_ended_the_episode() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 86.0, 4, TERMINATED); // at its own goal, 90
        let rule = rule(Some(0.5));
        let outcome = |slot, offset, goal: f32| {
            let goal = Goal { rule: &rule, values: &[goal] };
            replay.outcome(&replay.window(slot, offset).unwrap(), goal)
        };
        assert_eq!(outcome(0, 0, 88.0), Some(Outcome { steps: 2, terminated: true }));
        // With another goal the episode would have gone on after its last step.
        assert_eq!(outcome(0, 1, 50.0), Some(Outcome { steps: 3, terminated: false }));
        // A short window cannot go on, because its further actions are unknown.
        assert_eq!(outcome(0, 2, 50.0), None);
        assert_eq!(outcome(0, 2, 89.0), Some(Outcome { steps: 1, terminated: true }));
    }

    #[test]
    fn an_end_for_another_reason_than_the_goal_remains() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 10.0, 4, TERMINATED); // far from its own goal
        let goal = Goal { rule: &rule(Some(0.5)), values: &[50.0] };
        let outcome = replay.outcome(&replay.window(0, 2).unwrap(), goal).unwrap();
        assert_eq!(outcome, Outcome { steps: 2, terminated: true });
    }

    #[test]
    fn the_same_seed_draws_the_same_goals_from_a_replay_read_from_a_file() {
        let mut replay = Replay::new(LAYOUT, 60, 1, 1);
        for index in 0..9 {
            episode(&mut replay, 10.0 * index as f32, 8, TRUNCATED);
        }
        let mut bytes = Vec::new();
        replay.write(&mut bytes).unwrap();
        let mut read = Replay::new(LAYOUT, 60, 1, 1);
        read.read(&mut bytes.as_slice()).unwrap();
        let goals = sampler(Hindsight::Future, 0.8, None);
        let draws = |replay: &Replay| {
            let random = seeds::stream(1, "test", 0);
            let mut sampler = Sampler::new(Windows::Sliding, random);
            let draw = |_| {
                let window = sampler.draw(replay).unwrap();
                let goal = draw(replay, &goals, &window, sampler.random_mut());
                (window, goal)
            };
            (0..200).map(draw).collect::<Vec<_>>()
        };
        assert_eq!(draws(&read), draws(&replay));
    }
}
