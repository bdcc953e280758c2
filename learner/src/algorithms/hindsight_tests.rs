//! Batches with other goals, and targets within what a sparse reward allows, worked by hand.

use dmprl_shared::config::{
    AlgorithmConfig, AlgorithmName, ExperimentConfig, Hindsight, Target, Windows,
};
use dmprl_shared::goal_rule::{GoalReward, GoalRule};
use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TERMINATED, TRUNCATED};

use super::tests::case;
use super::*;
use crate::learner::tests::goal_rule;
use crate::replay::{GoalSampler, Replay, Sampler};

/// Observations are (achieved goal, desired goal).
const LAYOUT: SegmentLayout = SegmentLayout { segment_steps: 2, observation_len: 2, action_len: 1 };
const SHAPE: BatchShape = BatchShape {
    rows: 64,
    observation_len: 2,
    actions_len: 2,
    end_state_len: 0,
    segment_actions_len: 2,
    action_len: 1,
    next_noise: false,
    noise: false,
    outcome: None,
};

fn rule(ends_within: Option<f64>) -> GoalRule {
    GoalRule { ends_within, ..goal_rule() }
}

/// An episode of three steps that achieves 1, 2 and 3, with the goal 9: r = -1, u = 0.1, 0.2, 0.3.
fn replay(flag: u32) -> Replay {
    let mut replay = Replay::new(LAYOUT, 1_000, 1, 1);
    let whole = [0.0, 9.0, 1.0, 9.0, 2.0, 9.0, 0.1, 0.2, -1.0, -1.0];
    let rest = [2.0, 9.0, 3.0, 9.0, 0.0, 0.0, 0.3, 0.0, -1.0, 0.0];
    for (block, episode_step, steps_len, flags) in [(whole, 0, 2, 0), (rest, 2, 1, flag)] {
        let header = SegmentHeader { episode_step, steps_len, flags, ..Default::default() };
        replay.insert(&header, &block);
    }
    replay
}

/// (s_t with its goal, actions, reward, bootstrap, state with its goal to bootstrap from).
type Row = ([f32; 2], [f32; 2], f32, f32, [f32; 2]);

/// Returns the distinct rows of a batch whose windows all get another goal, and the target range.
fn rows(replay: &Replay, config: &AlgorithmConfig, rule: &GoalRule) -> (Vec<Row>, [f32; 2]) {
    rows_of(replay, config, GoalSampler::new(Some(rule), Hindsight::Final, 1.0))
}

fn rows_of(
    replay: &Replay,
    config: &AlgorithmConfig,
    hindsight: Option<GoalSampler>,
) -> (Vec<Row>, [f32; 2]) {
    let random = dmprl_shared::seeds::stream(1, "test", 0);
    let mut sampler = Sampler::new(Windows::Sliding, random);
    let mut batch = Batch::new(SHAPE);
    let mut source = SampleSource {
        replay,
        sampler: &mut sampler,
        hindsight: hindsight.as_ref(),
        jerk_cost: None,
        normaliser: None,
    };
    batch.sample(SHAPE, config, 1.0, &mut source).unwrap();
    let mut rows: Vec<Row> = (0..SHAPE.rows)
        .map(|row| {
            let pair = |values: &[f32]| [values[2 * row], values[2 * row + 1]];
            let input = &batch.critic_inputs[4 * row..4 * row + 4];
            assert_eq!(input[..2], batch.observations[2 * row..2 * row + 2]);
            assert_eq!(batch.inputs, batch.observations);
            let (reward, factor) = (batch.rewards[row], batch.bootstrap[row]);
            let actions = [input[2], input[3]];
            (pair(&batch.observations), actions, reward, factor, pair(&batch.next_observations))
        })
        .collect();
    rows.sort_by(|a, b| a.0[0].total_cmp(&b.0[0]));
    rows.dedup();
    (rows, batch.target_range)
}

fn config() -> AlgorithmConfig {
    AlgorithmConfig { discount: 0.5, ..AlgorithmConfig::default() }
}

#[test]
fn a_batch_with_other_goals_is_that_worked_by_hand() {
    let (rows, range) = rows(&replay(TRUNCATED), &config(), &rule(None));
    // The final goal is 3. -1 - 0.5; then -1 + 0.5 * 0, because step 2 reaches it.
    let expected = [
        ([0.0, 3.0], [0.1, 0.2], -1.5, 0.25, [2.0, 3.0]),
        ([1.0, 3.0], [0.2, 0.3], -1.0, 0.25, [3.0, 3.0]),
    ];
    assert_eq!(rows, expected);
    assert_eq!(range, [-2.0, 0.0]);
}

#[test]
fn a_step_that_moves_the_achieved_goal_gets_a_bonus_while_few_episodes_do() {
    let mut replay = replay(TRUNCATED);
    // Episodes are counted after 100 segments.
    let still = [5.0, 9.0, 5.0, 9.0, 5.0, 9.0, 0.4, 0.5, -1.0, -1.0];
    for episode in 1..=98 {
        let header =
            SegmentHeader { episode, steps_len: 2, flags: TRUNCATED, ..Default::default() };
        replay.insert(&header, &still);
    }
    let mut config = ExperimentConfig { algorithm: config(), ..ExperimentConfig::default() };
    config.replay.hindsight = Hindsight::Final;
    config.replay.hindsight_share = 0.0;
    config.replay.moved_share = 1.0;
    config.algorithm.motion_bonus = 0.5;
    let mut hindsight = GoalSampler::from_config(Some(&rule(None)), &config);
    hindsight.as_mut().unwrap().read_recent(&replay);
    let (rows, range) = rows_of(&replay, &config.algorithm, hindsight);
    // -1 - 0.5, and 0.5 + 0.25 for two steps that move it.
    let expected = [
        ([0.0, 9.0], [0.1, 0.2], -0.75, 0.25, [2.0, 9.0]),
        ([1.0, 9.0], [0.2, 0.3], -0.75, 0.25, [3.0, 9.0]),
        ([5.0, 9.0], [0.4, 0.5], -1.5, 0.25, [5.0, 9.0]),
    ];
    assert_eq!(rows, expected);
    assert_eq!(range, [-2.0, 1.0]);
}

#[test]
fn literal_targets_get_other_goals_too_and_have_no_range() {
    let config = AlgorithmConfig { target: Target::Literal, ..config() };
    let (rows, range) = rows(&replay(TRUNCATED), &config, &rule(None));
    let expected = [
        ([0.0, 3.0], [0.1, 0.2], -2.0, 0.5, [1.0, 3.0]),
        ([1.0, 3.0], [0.2, 0.3], -1.0, 0.5, [2.0, 3.0]),
    ];
    assert_eq!(rows, expected);
    assert_eq!(range, [f32::NEG_INFINITY, f32::INFINITY]);
    let sac = AlgorithmConfig { name: AlgorithmName::Sac, ..self::config() };
    let (_, range) = self::rows(&replay(TRUNCATED), &sac, &rule(None));
    assert_eq!(range, [f32::NEG_INFINITY, f32::INFINITY]);
}

#[test]
fn a_window_that_reaches_its_new_goal_early_terminates_and_has_no_later_actions() {
    // Reached within 1.5, so already by step 1, which achieves 2.
    let rule = GoalRule {
        reward: GoalReward::Sparse { threshold: 1.5, reached: 0.0, missed: -1.0 },
        ..rule(Some(1.5))
    };
    let (rows, _) = rows(&replay(TERMINATED), &config(), &rule);
    let expected = [
        ([0.0, 3.0], [0.1, 0.2], -1.0, 0.0, [2.0, 3.0]),
        ([1.0, 3.0], [0.2, 0.0], 0.0, 0.0, [2.0, 3.0]),
        ([2.0, 3.0], [0.3, 0.0], 0.0, 0.0, [3.0, 3.0]),
    ];
    assert_eq!(rows, expected);
}

#[test]
fn whole_windows_that_led_to_their_goal_are_imitated() {
    // The final goal is 3, and both windows move towards it.
    let imitated_of = |config: AlgorithmConfig, rule: &GoalRule, flag, share| {
        let hindsight = GoalSampler::new(Some(rule), Hindsight::Final, share);
        let random = dmprl_shared::seeds::stream(1, "test", 0);
        let mut sampler = Sampler::new(Windows::Sliding, random);
        let (mut batch, replay) = (Batch::new(SHAPE), replay(flag));
        let mut source = SampleSource {
            replay: &replay,
            sampler: &mut sampler,
            hindsight: hindsight.as_ref(),
            jerk_cost: None,
            normaliser: None,
        };
        batch.sample(SHAPE, &config, 1.0, &mut source).unwrap();
        let actions = (0..SHAPE.rows).filter_map(|row| batch.imitated(SHAPE, row));
        let mut actions: Vec<_> = actions.map(<[f32]>::to_vec).collect();
        actions.sort_by(|a, b| a[0].total_cmp(&b[0]));
        actions.dedup();
        actions
    };
    let imitated = |config, rule: &GoalRule, flag| imitated_of(config, rule, flag, 1.0);
    let config = AlgorithmConfig { imitation_penalty: 0.1, ..config() };
    let both = [[0.1, 0.2], [0.2, 0.3]];
    assert_eq!(imitated(config.clone(), &rule(None), TRUNCATED), both);
    assert_eq!(imitated(config.clone(), &rule(Some(0.5)), TERMINATED), both);
    let wide = |threshold, ends_within| {
        let reward = GoalReward::Sparse { threshold, reached: 0.0, missed: -1.0 };
        GoalRule { reward, ..rule(ends_within) }
    };
    let early = imitated(config.clone(), &wide(1.5, Some(1.5)), TERMINATED);
    assert_eq!(early, both[..1], "the second one ends early");
    // The episode's own goal, 9, is reached from 3 on, or not at all.
    let own = |threshold| imitated_of(config.clone(), &wide(threshold, None), TRUNCATED, 0.0);
    assert_eq!(own(6.0), both);
    assert!(own(5.0).is_empty());
    assert!(imitated(self::config(), &rule(None), TRUNCATED).is_empty(), "no penalty");
}

#[test]
fn targets_beyond_the_range_are_those_at_its_end() {
    for name in ["ddpg", "td3"] {
        let keys = [("algorithm.name", name)];
        let (mut clipped, mut plain) = (case(&keys), case(&keys));
        clipped.batch.target_range = [-0.4, 0.1];
        clipped.check(&format!("{name}, clipped"));
        let mut clipped = case(&keys);
        clipped.batch.target_range = [-0.4, 0.1];
        clipped.batch.rewards.fill(5.0);
        plain.batch.rewards.fill(0.1);
        let loss = |case: &mut super::tests::Case| {
            case.batch.bootstrap.fill(0.0);
            case.algorithm.update(&case.policy, &case.batch, 1).unwrap().critic_loss
        };
        assert_eq!(loss(&mut clipped), loss(&mut plain), "{name}");
    }
}
