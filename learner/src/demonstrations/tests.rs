use std::collections::HashMap;

use candle_core::{DType, Device, Tensor};
use dmprl_shared::config::{ExperimentConfig, Layers};
use dmprl_shared::segment::SegmentLayout;
use tempfile::TempDir;

use super::*;
use crate::learner::Learner;
use crate::off_policy::CloningLosses;
use crate::replay::Replay;

/// Returns two episodes of seven and three steps. The recording ends before the second episode
/// does. Step t has observation (t, 0, 0, episode), action (t / 5 - 1, 0) and reward -t.
pub(crate) fn steps() -> Demonstration {
    let mut steps = Demonstration::default();
    for (episode, len) in [(0.0, 7), (1.0, 3)] {
        for t in 0..len {
            let at = t as f32;
            steps.observations.extend([at, 0.0, 0.0, episode]);
            steps.next_observations.extend([at + 1.0, 0.0, 0.0, episode]);
            steps.actions.extend([at / 5.0 - 1.0, 0.0]);
            steps.rewards.push(-at);
            steps.terminated.push(episode == 0.0 && t + 1 == len);
            steps.truncated.push(false);
        }
    }
    steps
}

type Arrays = HashMap<&'static str, Tensor>;

/// Returns the arrays as NumPy writes them: numbers in 64 bits, flags in one byte.
fn arrays() -> Arrays {
    let Demonstration { observations, actions, rewards, next_observations, terminated, truncated } =
        steps();
    let wide = |values: Vec<f32>, width: usize| {
        let shape = (values.len() / width, width);
        let tensor = Tensor::from_vec(values, shape, &Device::Cpu).unwrap();
        tensor.to_dtype(DType::F64).unwrap()
    };
    let flags = |values: Vec<bool>| {
        let bytes: Vec<u8> = values.into_iter().map(u8::from).collect();
        Tensor::from_vec(bytes, 10, &Device::Cpu).unwrap()
    };
    HashMap::from([
        ("observations", wide(observations, 4)),
        ("actions", wide(actions, 2)),
        ("rewards", Tensor::from_vec(rewards, 10, &Device::Cpu).unwrap()),
        ("next_observations", wide(next_observations, 4)),
        ("terminated", flags(terminated)),
        ("truncated", flags(truncated)),
    ])
}

fn config(keys: &[(&str, &str)]) -> ExperimentConfig {
    let mut layers = Layers::new();
    let common = [
        ("policy.hidden", "[32]"),
        ("algorithm.critic_hidden", "[8]"),
        ("algorithm.batch_size", "32"),
        ("algorithm.actor_learning_rate", "0.003"),
        ("actors.workers", "1"),
        ("demonstrations.files", "['some.npz']"),
    ];
    for (key, value) in common.iter().chain(keys) {
        layers.set("test", key, value).unwrap();
    }
    layers.finish().unwrap()
}

fn learner(keys: &[(&str, &str)]) -> Learner {
    Learner::new(config(keys), &crate::learner::tests::spec(), 1).unwrap()
}

fn read(arrays: &Arrays) -> Result<Demonstration, DemonstrationError> {
    read_for(&learner(&[]), arrays)
}

fn read_for(learner: &Learner, arrays: &Arrays) -> Result<Demonstration, DemonstrationError> {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("demos.npz");
    let named: Vec<_> = arrays.iter().map(|(name, tensor)| (*name, tensor)).collect();
    Tensor::write_npz(&named, &path).unwrap();
    Demonstration::read(&path, &crate::learner::tests::spec(), learner.policy())
}

#[test]
fn actions_outside_the_share_that_the_policy_uses_are_refused() {
    let learner = learner(&[("policy.action_range", "0.5")]);
    let message = read_for(&learner, &arrays()).unwrap_err().to_string();
    for word in ["actions, row 0 entry 0", "-0.5 to 0.5", "policy.action_range", "got -1"] {
        assert!(message.contains(word), "{word}: {message}");
    }
}

#[test]
fn a_file_is_read_as_it_was_written() {
    let read = read(&arrays()).unwrap();
    assert_eq!(read, steps());
    let summary = DemonstrationSummary { episodes: 2, steps: 10, rewards: -24.0 };
    assert_eq!(read.summary(), summary);
}

#[test]
fn states_of_the_commands_follow_the_recorded_actions() {
    let learner = learner(&[("policy.start", "action"), ("policy.controller", "direct")]);
    let read = read_for(&learner, &arrays()).unwrap();
    assert_eq!((read.observations.len(), read.next_observations.len()), (10 * 8, 10 * 8));
    let commands = learner.policy().command_state().unwrap();
    let mut state = [0.0; 4];
    for (row, seen) in read.observations.chunks_exact(8).enumerate() {
        // Each of the two episodes begins at rest.
        if row == 7 {
            state = [0.0; 4];
        }
        assert_eq!((&seen[..4], &seen[4..]), (&steps().observations[4 * row..][..4], &state[..]));
        commands.follow(&read.actions[2 * row..][..2], &mut state);
        assert_eq!(read.next_observations[8 * row + 4..][..4], state);
    }
}

/// Damages each array in turn. The message names the array, the expected and the actual value.
#[test]
fn what_does_not_fit_is_refused_by_name_with_expected_and_got() {
    let at = |values: &mut Arrays, key: &'static str, index: usize, value: f64| {
        let tensor = &values[key];
        let mut flat: Vec<f64> =
            tensor.to_dtype(DType::F64).unwrap().flatten_all().unwrap().to_vec1().unwrap();
        flat[index] = value;
        let new = Tensor::from_vec(flat, tensor.shape().clone(), &Device::Cpu).unwrap();
        values.insert(key, new);
    };
    let zeros = |shape: &[usize]| Tensor::zeros(shape, DType::F64, &Device::Cpu).unwrap();
    type Spoil<'a> = Box<dyn Fn(&mut Arrays) + 'a>;
    let cases: Vec<(Spoil<'_>, [&str; 3])> = vec![
        (
            Box::new(|a| drop(a.remove("truncated"))),
            ["truncated", "arrays observations", "got actions, next_observations"],
        ),
        (
            Box::new(|a| drop(a.insert("observations", zeros(&[10, 3])))),
            ["observations", "shape (10, 4)", "got (10, 3)"],
        ),
        (
            Box::new(|a| drop(a.insert("rewards", zeros(&[10, 1])))),
            ["rewards", "shape (N,)", "got (10, 1)"],
        ),
        (
            Box::new(|a| at(a, "next_observations", 9, f64::NAN)),
            ["next_observations, row 2 observation[1]", "finite", "got NaN"],
        ),
        (
            Box::new(|a| at(a, "actions", 7, 1.01)),
            ["actions, row 3 entry 1", "-1 to 1", "got 1.01"],
        ),
        (Box::new(|a| at(a, "terminated", 4, 2.0)), ["terminated, row 4", "0 or 1", "got 2"]),
        (
            Box::new(|a| at(a, "next_observations", 4, 9.0)),
            ["next_observations, row 1", "observations of row 2", "got 9"],
        ),
        (Box::new(|a| at(a, "rewards", 0, 1e39)), ["rewards, row 0", "finite 32-bit", "got 1"]),
    ];
    for (spoil, words) in cases {
        let mut spoilt = arrays();
        spoil(&mut spoilt);
        let message = read(&spoilt).unwrap_err().to_string();
        for word in words.into_iter().chain(["demos.npz", "docs/demonstrations.md"]) {
            assert!(message.contains(word), "{word}: {message}");
        }
    }
}

#[test]
fn what_is_no_archive_is_refused_with_how_to_write_one() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("demos.npz");
    std::fs::write(&path, b"PK no archive").unwrap();
    let spec = crate::learner::tests::spec();
    let error = Demonstration::read(&path, &spec, learner(&[]).policy()).unwrap_err().to_string();
    assert!(error.contains("numpy.savez"), "{error}");
}

const LAYOUT: SegmentLayout = SegmentLayout { segment_steps: 5, observation_len: 4, action_len: 2 };

/// Returns first observation, length and termination of every window.
fn windows(replay: &Replay) -> Vec<([f32; 2], usize, bool)> {
    let all = (0..replay.len()).flat_map(|slot| (0..5).map(move |offset| (slot, offset)));
    let windows = all.filter_map(|(slot, offset)| replay.window(slot, offset));
    windows
        .map(|window| {
            let seen = replay.observation(&window);
            ([seen[3], seen[0]], window.len(), window.terminated)
        })
        .collect()
}

#[test]
fn episodes_become_windows_and_one_cut_short_gives_none_that_is_short() {
    let mut replay = Replay::new(LAYOUT, 100, 1, 1);
    steps().insert_into(&mut replay).unwrap();
    // Two segments and one. The three steps of the second episode are too few for a window of five.
    assert_eq!(replay.len(), 3);
    let expected: Vec<_> =
        (0..7_usize).map(|t| ([0.0, t as f32], (7 - t).min(5), t + 5 >= 7)).collect();
    assert_eq!(windows(&replay), expected);
}

#[test]
fn demonstrations_stay_when_all_else_is_replaced_also_through_a_checkpoint() {
    let mut replay = Replay::new(LAYOUT, 40, 1, 1); // 8 slots
    steps().insert_into(&mut replay).unwrap();
    let kept = windows(&replay);
    let insert = |replay: &mut Replay, number: u32| {
        let block = vec![9.0 + number as f32; LAYOUT.block_len()];
        let header =
            SegmentHeader { episode_step: 5 * number, steps_len: 5, ..SegmentHeader::default() };
        replay.insert(&header, &block);
    };
    (0..13).for_each(|number| insert(&mut replay, number));
    let mut file = Vec::new();
    replay.write(&mut file).unwrap();
    let mut again = Replay::new(LAYOUT, 40, 1, 1);
    again.read(&mut file.as_slice()).unwrap();
    for replay in [&mut replay, &mut again] {
        (13..21).for_each(|number| insert(replay, number));
        let now = windows(replay);
        assert_eq!(now[..kept.len()], kept);
        // Five slots remain for the newest segments, whose chain continues across the ring's end.
        let newest: Vec<f32> =
            now.iter().map(|window| window.0[0]).filter(|&seen| seen >= 9.0).collect();
        assert_eq!(newest.len(), 4 * 5 + 1);
        assert!(newest.iter().all(|&seen| seen >= 25.0), "{newest:?}");
    }
}

#[test]
fn more_than_half_of_a_replay_is_refused() {
    let mut replay = Replay::new(LAYOUT, 25, 1, 1);
    let message = steps().insert_into(&mut replay).unwrap_err().to_string();
    assert!(message.contains("3 segments") && message.contains("the replay's 5"), "{message}");
}

#[test]
fn a_cloned_policy_does_what_was_demonstrated() {
    for keys in [
        &[][..],
        &[("policy.kind", "mlp")],
        &[("policy.kind", "chunk")],
        &[("algorithm.name", "sac"), ("policy.normalise_observations", "true")],
        &[("algorithm.name", "tqc"), ("algorithm.critic_layer_norm", "true")],
        &[("algorithm.critic", "first"), ("algorithm.windows", "segment")],
    ] {
        let updates = [("demonstrations.cloning_updates", "400")];
        let mut learner = learner(&[keys, &updates].concat());
        let CloningLosses { first, last } = learner.demonstrate(&[steps()]).unwrap().unwrap();
        assert!(last < 0.1 * first, "{keys:?}: {first}, then {last}");
        let steps = learner.policy().layout().segment_steps;
        let mut work = learner.policy().workspace(1);
        let snapshot = learner.next_snapshot().unwrap().values.clone();
        learner.policy().act(&snapshot, &[0.0; 4], &mut work);
        for (t, u) in work.actions.chunks_exact(2).take(steps).enumerate() {
            let wanted = [t as f32 / 5.0 - 1.0, 0.0];
            let close = u.iter().zip(wanted).all(|(u, wanted)| (u - wanted).abs() < 0.2);
            assert!(close, "{keys:?}, step {t}: {u:?}, expected {wanted:?}");
        }
        let counters = learner.counters;
        assert_eq!((counters.env_steps, counters.segments, counters.updates), (0, 0, 0));
        assert!(learner.update().is_ok(), "demonstrations are samples at once");
    }
}

/// Compares two learners whose critics differ. Their actors are equal while they only imitate.
#[test]
fn an_actor_follows_its_critic_after_the_warm_up_and_then_more_and_more() {
    let distance = |env_steps: u64| {
        let actor = |rate: &str| {
            let keys = [
                ("algorithm.critic_learning_rate", rate),
                ("exploration.warm_up_steps", "100"),
                ("demonstrations.cloning_updates", "1"),
                ("demonstrations.imitation_steps", "1000"),
            ];
            let mut learner = learner(&keys);
            learner.demonstrate(&[steps()]).unwrap();
            learner.counters.env_steps = env_steps;
            (0..10).for_each(|_| learner.update().unwrap());
            learner.next_snapshot().unwrap().values.clone()
        };
        let (slow, quick) = (actor("0.0003"), actor("0.03"));
        slow.iter().zip(&quick).map(|(a, b)| (a - b).abs()).sum::<f32>()
    };
    let [warm_up, early, late, over] = [100, 200, 800, 1_100].map(distance);
    assert_eq!(warm_up, 0.0);
    assert!(0.0 < early && early < late && late < over, "{early} {late} {over}");
}

#[test]
fn the_configured_share_reaches_the_sampler() {
    for (share, expected) in [("0", false), ("1", true)] {
        let mut learner = learner(&[("demonstrations.share", share)]);
        learner.demonstrate(&[steps()]).unwrap();
        let drawn = learner.sampler.draw_due_demonstration(&learner.replay);
        assert_eq!(drawn.is_some(), expected, "{share}");
    }
}
