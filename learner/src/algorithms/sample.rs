//! A sample of a batch: a window, with another goal if hindsight draws one.

use dmprl_shared::config::{AfterTimeLimit, AlgorithmConfig, Target};

use crate::normaliser::Normaliser;
use crate::replay::{Goal, GoalSampler, JerkCost, Outcome, Replay, Sampler, Window};

/// The source of a batch's samples.
#[derive(Debug)]
pub struct SampleSource<'a> {
    /// The experience.
    pub replay: &'a Replay,
    /// Draws the windows.
    pub sampler: &'a mut Sampler,
    /// Draws other goals for windows, if configured.
    pub hindsight: Option<&'a GoalSampler>,
    /// Cost of jerk, if configured.
    pub jerk_cost: Option<&'a JerkCost>,
    /// Normalises network inputs, if configured.
    pub normaliser: Option<&'a Normaliser>,
}

impl SampleSource<'_> {
    /// Borrows the source again, for one of several samples.
    pub fn reborrow(&mut self) -> SampleSource<'_> {
        SampleSource { sampler: self.sampler, ..*self }
    }
}

/// A window with the goal and the outcome that the batch takes.
pub(super) struct Sample<'a> {
    pub(super) window: Window,
    pub(super) outcome: Outcome,
    /// Another goal, or `None` for the window's own.
    pub(super) goal: Option<Goal<'a>>,
    /// Adds a bonus to the reward, if configured.
    pub(super) hindsight: Option<&'a GoalSampler>,
    /// Subtracts the cost of jerk from the reward, if configured.
    pub(super) jerk_cost: Option<&'a JerkCost>,
}

impl<'a> Sample<'a> {
    /// Draws a window, and a goal for it, if hindsight is configured. Returns `None` if the replay
    /// has no window. `buffer` keeps a goal that nothing in the replay has.
    pub(super) fn draw<'s: 'a>(
        source: &mut SampleSource<'s>,
        buffer: &'a mut Vec<f32>,
    ) -> Option<Self> {
        let SampleSource { replay, sampler, hindsight, jerk_cost, .. } = source;
        let (replay, hindsight, jerk_cost) = (*replay, *hindsight, *jerk_cost);
        let window = match (sampler.draw_due_demonstration(replay), hindsight) {
            (Some(demonstrated), _) => demonstrated,
            (None, Some(hindsight)) => hindsight.draw_window(replay, sampler)?,
            (None, None) => sampler.draw(replay)?,
        };
        let drawn = hindsight.and_then(|hindsight| {
            let goal = hindsight.draw(replay, &window, sampler.random_mut(), buffer)?;
            let outcome = replay.outcome(&window, goal)?;
            Some(Self { window, outcome, goal: Some(goal), hindsight: Some(hindsight), jerk_cost })
        });
        Some(drawn.unwrap_or_else(|| {
            let outcome = Outcome { steps: window.len(), terminated: window.terminated };
            Self { window, outcome, goal: None, hindsight, jerk_cost }
        }))
    }
}

impl Sample<'_> {
    /// Returns the sum of discount^i r_i over the steps, with the bonus for motion and the cost of
    /// jerk.
    pub(super) fn discounted_reward(&self, replay: &Replay, discount: f32) -> f32 {
        let Self { window, outcome: Outcome { steps, .. }, goal, hindsight, jerk_cost } = self;
        let reward = match goal {
            None => replay.discounted_reward(window, discount),
            Some(goal) => replay.discounted_goal_reward(window, *steps, *goal, discount),
        };
        let bonus =
            |sampler: &&GoalSampler| sampler.discounted_bonus(replay, window, *steps, discount);
        let cost = |cost: &&JerkCost| cost.discounted(replay, window, *steps, discount);
        reward + hindsight.as_ref().map_or(0.0, bonus) - jerk_cost.as_ref().map_or(0.0, cost)
    }

    /// Returns the return after the last step, if it is known: with `after_time_limit =
    /// "last_reward"`, that of the last reward in every step for ever.
    pub(super) fn reward_after(&self, replay: &Replay, config: &AlgorithmConfig) -> Option<f32> {
        let Self { window, outcome, goal, .. } = self;
        let is_last = outcome.steps == window.len() && !outcome.terminated;
        let holds = config.after_time_limit == AfterTimeLimit::LastReward;
        if !(holds && is_last && replay.ends_at_time_limit(window)) {
            return None;
        }
        let reward = match goal {
            None => replay.last_reward(window),
            Some(Goal { rule, values }) => {
                let last = replay.observation_after(window, outcome.steps);
                rule.reward(rule.distance(rule.achieved(last), values))
            }
        };
        Some(reward / (1.0 - config.discount as f32))
    }

    /// Returns whether the window led to its goal, with all its steps.
    pub(super) fn led_to_goal(&self, replay: &Replay) -> bool {
        let Self { window, outcome, goal, hindsight, .. } = self;
        let Some(rule) = hindsight.map(|hindsight| &hindsight.rule) else { return false };
        let own = || rule.desired(replay.observation(window));
        let values = goal.map_or_else(own, |goal| goal.values);
        let is_whole = outcome.steps == replay.layout().segment_steps;
        is_whole && replay.led_to(window, Goal { rule, values })
    }
}

/// Returns the range of the targets: that of the returns that a sparse goal rule allows. The soft
/// values of SAC and TQC and the undiscounted sums of `literal` have no such range, and with a cost
/// of jerk there is no smallest return.
pub(super) fn target_range(hindsight: Option<&GoalSampler>, config: &AlgorithmConfig) -> [f32; 2] {
    let is_return = config.target == Target::NStep && !config.name.has_gaussian_policy();
    let [low, high] = hindsight
        .filter(|_| is_return)
        .and_then(|hindsight| hindsight.return_range(config.discount))
        .unwrap_or([f32::NEG_INFINITY, f32::INFINITY]);
    [if config.jerk_cost > 0.0 { f32::NEG_INFINITY } else { low }, high]
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::{ExperimentConfig, Hindsight, StartSource, Windows};
    use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TERMINATED, TRUNCATED};
    use dmprl_shared::spec::EnvSpec;

    use super::*;
    use crate::learner::tests::{goal_rule, spec};

    #[test]
    fn samples_with_and_without_hindsight_take_the_share_of_the_demonstrations() {
        let layout = SegmentLayout { segment_steps: 1, observation_len: 2, action_len: 1 };
        let mut replay = Replay::new(layout, 100, 1, 1);
        let header = SegmentHeader { steps_len: 1, flags: TERMINATED, ..Default::default() };
        replay.insert_demonstration(&header, &[7.0, 0.0, 7.0, 0.0, 0.1, -1.0]);
        (0..20).for_each(|_| replay.insert(&header, &[1.0, 0.0, 1.0, 0.0, 0.1, -1.0]));
        let goals = GoalSampler::new(Some(&goal_rule()), Hindsight::Final, 1.0);
        for hindsight in [None, goals.as_ref()] {
            let demonstrated = |share| {
                let random = dmprl_shared::seeds::stream(1, "test", 0);
                let mut sampler = Sampler::new(Windows::Segment, random).with_demonstrated(share);
                let mut draw = || {
                    let mut source = SampleSource {
                        replay: &replay,
                        sampler: &mut sampler,
                        hindsight,
                        jerk_cost: None,
                        normaliser: None,
                    };
                    Sample::draw(&mut source, &mut Vec::new()).unwrap().window
                };
                (0..50).filter(|_| replay.observation(&draw())[0] == 7.0).count()
            };
            assert_eq!(demonstrated(1.0), 50);
            assert!(demonstrated(0.0) < 25);
        }
    }

    #[test]
    fn a_cost_of_jerk_lowers_rewards_and_the_smallest_target() {
        let layout = SegmentLayout { segment_steps: 2, observation_len: 2, action_len: 1 };
        let mut replay = Replay::new(layout, 100, 1, 1);
        let header = SegmentHeader { steps_len: 2, flags: TRUNCATED, ..Default::default() };
        // The velocities are 0, 1 and 4, so the second step has a second difference of 2.
        replay.insert(&header, &[9.0, 0.0, 9.0, 1.0, 9.0, 4.0, 0.1, 0.2, -1.0, -1.0]);
        let mut config = ExperimentConfig::default();
        config.algorithm.jerk_cost = 0.25;
        config.task.start_sources = vec![StartSource::Value { index: 0, velocity: 1, scale: 1.0 }];
        let env = EnvSpec { observation_len: 2, action_len: 1, control_dt_s: 0.5, ..spec() };
        let cost = JerkCost::from_config(&config, &env).unwrap();
        let window = replay.window(0, 0).unwrap();
        let reward = |jerk_cost| {
            let outcome = Outcome { steps: 2, terminated: false };
            let sample = Sample { window, outcome, goal: None, hindsight: None, jerk_cost };
            sample.discounted_reward(&replay, 0.5)
        };
        assert_eq!((reward(None), reward(cost.as_ref())), (-1.5, -2.5));

        let goals = GoalSampler::new(Some(&goal_rule()), Hindsight::Final, 1.0);
        let [low, high] = target_range(goals.as_ref(), &AlgorithmConfig::default());
        assert!(low.is_finite());
        assert_eq!(target_range(goals.as_ref(), &config.algorithm), [f32::NEG_INFINITY, high]);
    }

    #[test]
    fn last_reward_lasts_for_ever_after_the_time_limit_only() {
        let layout = SegmentLayout { segment_steps: 1, observation_len: 2, action_len: 1 };
        let mut replay = Replay::new(layout, 100, 1, 1);
        for (episode, flags) in [(0, TERMINATED), (1, TRUNCATED)] {
            for (episode_step, flags) in [(0, 0), (1, flags)] {
                let header = SegmentHeader {
                    episode,
                    episode_step,
                    steps_len: 1,
                    flags,
                    ..Default::default()
                };
                // The achieved goal goes from 1 to 3, the desired goal is 9.
                replay.insert(&header, &[1.0, 9.0, 3.0, 9.0, 0.1, -1.0]);
            }
        }
        let rule = goal_rule();
        let after = |slot, values: Option<&[f32]>, after_time_limit| {
            let window = replay.window(slot, 0).unwrap();
            let outcome = Outcome { steps: 1, terminated: window.terminated };
            let goal = values.map(|values| Goal { rule: &rule, values });
            let config =
                AlgorithmConfig { after_time_limit, discount: 0.75, ..AlgorithmConfig::default() };
            Sample { window, outcome, goal, hindsight: None, jerk_cost: None }
                .reward_after(&replay, &config)
        };
        let slots = |values, after_time_limit| {
            [0, 1, 2, 3].map(|slot| after(slot, values, after_time_limit))
        };
        let unknown = [None; 4];
        assert_eq!(slots(None, AfterTimeLimit::Bootstrap), unknown);
        assert_eq!(slots(None, AfterTimeLimit::LastReward), [None, None, None, Some(-4.0)]);
        let reached = slots(Some(&[3.0]), AfterTimeLimit::LastReward);
        assert_eq!(reached, [None, None, None, Some(0.0)]);
    }
}
