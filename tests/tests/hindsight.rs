//! Copies of segments with goals that their episode reached, in a real interpreter.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::collections::{BTreeMap, HashSet};
use std::sync::OnceLock;

use dmprl_actors::python_env::{Interpreter, InterpreterOptions, PythonEnvironments};
use dmprl_actors::rollout::{Identity, Rollout, RolloutError};
use dmprl_shared::config::{ExperimentConfig, Layers, TaskConfig};
use dmprl_shared::goal_rule::GoalReward;
use dmprl_shared::policy::CommandState;
use dmprl_shared::segment::{
    ActionBounds, Expected, HINDSIGHT, Segment, SegmentLayout, TERMINATED, TRUNCATED, check,
};
use dmprl_tests::{tiny_envs_dir, venv};

const ENVS: usize = 2;
/// Achieved goal, desired goal, position, steps taken.
const LAYOUT: SegmentLayout = SegmentLayout { segment_steps: 5, observation_len: 4, action_len: 1 };

fn config(keys: &[(&str, &str)]) -> ExperimentConfig {
    let mut layers = Layers::new();
    let common = [
        ("actors.envs_per_worker", "2"),
        ("policy.hidden", "[8]"),
        ("exploration.warm_up_range", "1.0"),
        ("replay.hindsight", "future"),
    ];
    for (key, value) in common.iter().chain(keys) {
        layers.set("test", key, value).unwrap();
    }
    layers.finish().unwrap()
}

const IDENTITY: Identity = Identity { run_id: 1, worker_id: 0, incarnation: 0, seed_index: 0 };

fn started(task: &str, keys: &[(&str, &str)]) -> Result<Rollout, RolloutError> {
    Rollout::start(&config(keys), environments(task), IDENTITY)
}

fn environments(task: &str) -> PythonEnvironments {
    static INTERPRETER: OnceLock<Interpreter> = OnceLock::new();
    let start = || {
        let (venv, python_path) = (venv().venv.clone(), vec![tiny_envs_dir()]);
        Interpreter::start(&InterpreterOptions { venv, python_path }).unwrap()
    };
    let interpreter = INTERPRETER.get_or_init(start);
    let task = TaskConfig::with_id(&format!("tiny_envs:{task}-v0"));
    PythonEnvironments::start(interpreter, &task, ENVS, 5).unwrap()
}

fn delivered(rollout: &mut Rollout, calls: usize) -> Vec<Segment> {
    let mut segments = Vec::new();
    for _ in 0..calls {
        let before = segments.len();
        rollout
            .segment(&mut |header, block| {
                segments.push(Segment { header: *header, block: block.to_vec() });
                Ok::<(), RolloutError>(())
            })
            .unwrap();
        assert!(segments.len() - before <= rollout.segments_max());
    }
    segments
}

fn is_copy(segment: &Segment) -> bool {
    segment.header.flags & HINDSIGHT != 0
}

/// Returns the position after each step of the episodes in the real segments, by environment and
/// episode; the first is the start.
fn places(segments: &[Segment]) -> BTreeMap<(u32, u32), Vec<f32>> {
    let mut places: BTreeMap<_, Vec<f32>> = BTreeMap::new();
    for segment in segments.iter().filter(|segment| !is_copy(segment)) {
        let header = &segment.header;
        let episode = places.entry((header.env_index, header.episode)).or_default();
        let rows = segment.block.chunks_exact(4).take(header.steps_len as usize + 1);
        let skipped = usize::from(!episode.is_empty());
        episode.extend(rows.skip(skipped).map(|row| row[2]));
    }
    places
}

/// Checks each copy against its episode: same positions, a goal reached later, and that goal's
/// rewards.
fn assert_faithful(segments: &[Segment], ends: bool) {
    let places = places(segments);
    for copy in segments.iter().filter(|segment| is_copy(segment)) {
        let header = &copy.header;
        let (first, len) = (header.episode_step as usize, header.steps_len as usize);
        let places = &places[&(header.env_index, header.episode)];
        let (observations, actions, rewards) = LAYOUT.split(&copy.block);
        let goal = observations[1];
        let reached: Vec<bool> =
            (1..=len).map(|step| (places[first + step] - goal).abs() <= 0.5).collect();
        for (row, seen) in observations.chunks_exact(4).take(len + 1).enumerate() {
            let place = places[first + row];
            assert_eq!(seen, [place, goal, place, (first + row) as f32]);
        }
        assert!(places[first + 1..].contains(&goal), "{goal} of {places:?} after {first}");
        let expected: Vec<f32> = reached.iter().map(|&near| f32::from(near) - 1.0).collect();
        assert_eq!(rewards[..len], expected);
        for step in 0..len {
            // An action is u in [-1, 1], scaled to [-2, 2]; half of it is the displacement.
            let moved = places[first + step + 1] - places[first + step];
            assert!((actions[step] - moved).abs() < 1e-5);
        }
        let terminated = ends && reached[len - 1];
        assert_eq!(header.flags & TERMINATED != 0, terminated);
        assert!(!ends || !reached[..len - 1].contains(&true), "it continued after its end");
        assert!(terminated || len == 5);
    }
}

#[test]
fn copies_of_an_episode_have_goals_that_it_reached_and_their_rewards() {
    let mut rollout = started("Reach", &[]).unwrap();
    // Episodes of twelve steps: three segments, the last of two steps.
    let segments = delivered(&mut rollout, 6);
    let copies = segments.iter().filter(|segment| is_copy(segment)).count();
    assert_eq!((segments.len() - copies, copies), (12, 2 * 2 * 3 * 4));
    assert_faithful(&segments, false);
    // Windows slide, so a copy may begin at any step that leaves it complete.
    let firsts: HashSet<u32> = segments
        .iter()
        .filter(|segment| is_copy(segment))
        .map(|segment| segment.header.episode_step)
        .collect();
    assert!(firsts.iter().all(|&first| first <= 7) && firsts.len() == 8, "{firsts:?}");
}

/// With `policy.start = "action"`, (y, yd) of the action before follows every observation.
#[test]
fn segments_and_copies_contain_the_actions_before_each_step() {
    let keys = [("policy.start", "action"), ("policy.controller", "direct")];
    let mut rollout = started("Reach", &keys).unwrap();
    let layout = SegmentLayout { observation_len: 6, ..LAYOUT };
    assert_eq!(rollout.policy().layout(), layout);
    let segments = delivered(&mut rollout, 6);
    let mut states: BTreeMap<(u32, u32), Vec<[f32; 2]>> = BTreeMap::new();
    let key = |segment: &Segment| (segment.header.env_index, segment.header.episode);
    for segment in segments.iter().filter(|segment| !is_copy(segment)) {
        // An episode starts at rest.
        let states = states.entry(key(segment)).or_insert_with(|| vec![[0.0; 2]]);
        let (_, actions, _) = layout.split(&segment.block);
        for u in &actions[..segment.header.steps_len as usize] {
            let y = u.clamp(-CommandState::U_MAX, CommandState::U_MAX).atanh();
            states.push([y, 5.0 * (y - states.last().unwrap()[0])]);
        }
    }
    let mut copies = 0;
    for segment in &segments {
        let first = segment.header.episode_step as usize;
        let rows = segment.block.chunks_exact(6).take(segment.header.steps_len as usize + 1);
        for (row, seen) in rows.enumerate() {
            assert_eq!(seen[4..], states[&key(segment)][first + row], "step {}", first + row);
        }
        copies += usize::from(is_copy(segment));
    }
    assert!(copies > 0);
}

/// With a proven rule the learner draws the goals, so the worker sends each step once.
#[test]
fn a_worker_makes_no_copies_if_the_reward_follows_a_rule() {
    for (task, has_rule) in [("Reach", true), ("ReachUndeclared", false)] {
        let mut environments = environments(task);
        environments.find_goal_rule().unwrap();
        let rule = environments.spec().goal_rule.clone();
        assert_eq!((rule.is_some(), environments.missing_rule().is_none()), (has_rule, has_rule));
        if let Some(rule) = rule {
            let reward = GoalReward::Sparse { threshold: 0.5, reached: 0.0, missed: -1.0 };
            assert_eq!((rule.achieved, rule.desired, rule.reward), (0, 1, reward));
        }
        let mut rollout = Rollout::start(&config(&[]), environments, IDENTITY).unwrap();
        let segments = delivered(&mut rollout, 6);
        assert_eq!(segments.iter().any(is_copy), !has_rule, "{task}");
    }
}

#[test]
fn copies_end_where_the_task_would_have_ended_the_episode() {
    let segments = delivered(&mut started("ReachEnds", &[]).unwrap(), 12);
    let short = |segment: &Segment| is_copy(segment) && segment.header.steps_len < 5;
    assert!(segments.iter().any(short));
    assert_faithful(&segments, true);
}

#[test]
fn copies_of_segments_begin_where_a_segment_did() {
    let keys = [("algorithm.windows", "segment"), ("replay.hindsight_copies", "2")];
    let segments = delivered(&mut started("Reach", &keys).unwrap(), 3);
    let copies: Vec<_> = segments.iter().filter(|segment| is_copy(segment)).collect();
    // The last two steps of an episode are not a complete segment.
    assert_eq!(copies.len(), 2 * 2 * 2);
    assert!(copies.iter().all(|copy| copy.header.episode_step.is_multiple_of(5)));
    assert_faithful(&segments, false);
}

#[test]
fn what_a_worker_sends_passes_the_learners_check_and_leaves_no_number_out() {
    let mut rollout = started("ReachEnds", &[]).unwrap();
    let expected = Expected {
        run_id: 1,
        architecture_hash: rollout.policy().architecture_hash(),
        layout: LAYOUT,
        action_bounds: ActionBounds::Unit,
        worker_count: 1,
        env_count: ENVS as u32,
    };
    for (index, segment) in delivered(&mut rollout, 9).iter().enumerate() {
        check(&segment.header, &segment.block, &expected).unwrap();
        assert_eq!(segment.header.sequence, index as u64 + 1);
    }
}

/// Each environment fails in its 12th step. Its third segment is discarded, and the ten sound steps
/// before it are an episode that ended there.
#[test]
fn the_sound_steps_before_a_failure_are_copied() {
    let mut rollout = started("FaultyReach", &[]).unwrap();
    let segments = delivered(&mut rollout, 3);
    assert_eq!(rollout.take_failures().len(), ENVS);
    let copies = segments.iter().filter(|segment| is_copy(segment)).count();
    assert_eq!((segments.len() - copies, copies), (2 * ENVS, 2 * ENVS * 4));
    assert!(segments.iter().all(|segment| segment.header.flags & TRUNCATED == 0));
    assert_faithful(&segments, false);
}

#[test]
fn the_same_seed_draws_the_same_goals() {
    let goals = |seed| {
        let segments = delivered(&mut started("Reach", &[("run.seed", seed)]).unwrap(), 3);
        segments.into_iter().filter(is_copy).map(|copy| copy.block).collect::<Vec<_>>()
    };
    assert_eq!(goals("3"), goals("3"));
    assert_ne!(goals("3"), goals("4"));
}

#[test]
fn an_environment_without_goals_or_time_limit_is_refused_with_what_helps() {
    for (task, reason) in [
        ("Long", "its observation is not a Dict"),
        ("ReachAlone", "takes one goal at a time"),
        ("ReachTimeless", "its episodes have no time limit"),
    ] {
        let error = started(task, &[]).err().unwrap().to_string();
        assert!(error.contains(reason), "{error}");
        assert!(error.contains("set replay.hindsight = \"none\""), "{error}");
    }
    assert!(started("Long", &[("replay.hindsight", "none")]).is_ok());
}

#[test]
fn a_reward_that_is_no_number_ends_the_worker() {
    let mut rollout = started("ReachNan", &[]).unwrap();
    let mut result = Ok(());
    for _ in 0..3 {
        result = rollout.segment(&mut |_, _| Ok::<(), RolloutError>(()));
    }
    let message = result.unwrap_err().to_string();
    assert!(message.contains("compute_reward returned NaN"), "{message}");
}
