//! Tests of the learner, and what other tests need of it.

use dmprl_shared::config::{Hindsight, StartSource};
use dmprl_shared::goal_rule::{GoalReward, GoalRule, Norm};
use dmprl_shared::segment::{SegmentHeader, TRUNCATED};

use super::*;

pub(crate) fn spec() -> EnvSpec {
    EnvSpec::new("Test-v0", 4, &[(-1.0, 1.0); 2], 0.02, 10)
}

/// Returns the rule of observations (achieved goal, desired goal, ...) with goals of one entry,
/// which are reached within 0.5.
pub(crate) fn goal_rule() -> GoalRule {
    GoalRule {
        achieved: 0,
        desired: 1,
        goal_len: 1,
        components: vec![0],
        norm: Norm::Euclidean,
        reward: GoalReward::Sparse { threshold: 0.5, reached: 0.0, missed: -1.0 },
        ends_within: None,
    }
}

#[test]
fn a_snapshot_is_settled_if_half_of_the_recent_episodes_move_the_achieved_goal() {
    let spec = EnvSpec { goal_rule: Some(goal_rule().into()), ..spec() };
    let mut config = ExperimentConfig::default();
    config.replay.hindsight = Hindsight::Future;
    // Segments are counted by hundreds; each is an episode here.
    for (moving, expected) in [(49, false), (50, true)] {
        let mut learner = Learner::new(config.clone(), &spec, 1).unwrap();
        let layout = learner.replay.layout();
        for episode in 0..100 {
            let mut block = vec![0.0; layout.block_len()];
            // The achieved goal after the last step.
            let last = layout.segment_steps * layout.observation_len;
            block[last] = if episode < moving { 1.0 } else { 0.0 };
            let steps_len = layout.segment_steps as u32;
            let header =
                SegmentHeader { episode, steps_len, flags: TRUNCATED, ..Default::default() };
            learner.replay.insert(&header, &block);
        }
        // No update has been made, as after a resume.
        assert_eq!(learner.next_snapshot().unwrap().settled, expected, "{moving} of 100");
    }
}

#[test]
fn updates_learn_from_the_cost_of_jerk() {
    let actor = |cost: f64| {
        let mut config = ExperimentConfig::default();
        config.algorithm.jerk_cost = cost;
        let source = |velocity| StartSource::Value { index: 0, velocity, scale: 1.0 };
        config.task.start_sources = vec![source(2), source(3)];
        let mut learner = Learner::new(config, &spec(), 1).unwrap();
        let layout = learner.replay.layout();
        let block: Vec<f32> = (0..layout.block_len()).map(|i| (i * i % 7) as f32 / 7.0).collect();
        let steps_len = layout.segment_steps as u32;
        let header = SegmentHeader { steps_len, flags: TRUNCATED, ..Default::default() };
        learner.replay.insert(&header, &block);
        (0..4).for_each(|_| learner.update().unwrap());
        let mut actor = vec![0.0; learner.policy().parameters_len()];
        learner.regime.read_policy(&mut actor).unwrap();
        actor
    };
    let without = actor(0.0);
    assert_eq!(without, actor(0.0));
    assert_ne!(without, actor(0.1));
}

#[test]
fn a_warm_start_of_plain_observations_remains_the_same_policy_with_relative_goals() {
    let spec = EnvSpec { goal_rule: Some(goal_rule().into()), ..spec() };
    let mut config = ExperimentConfig::default();
    config.replay.hindsight = Hindsight::Future;
    let mut learner = Learner::new(config, &spec, 1).unwrap();
    let start: Vec<f32> = learner.next_snapshot().unwrap().values.clone();
    learner.warm_start(&start).unwrap();
    let published = &learner.next_snapshot().unwrap().values;
    // The weights of the achieved goal are computed, so they are rounded.
    assert!(start.iter().zip(published).all(|(a, b)| (a - b).abs() < 1e-6));
    let mut actor = vec![0.0; start.len()];
    learner.regime.read_policy(&mut actor).unwrap();
    assert!(start.iter().zip(&actor).any(|(a, b)| (a - b).abs() > 1e-3));
}
