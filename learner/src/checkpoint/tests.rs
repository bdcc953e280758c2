use std::fs;

use dmprl_shared::config::Layers;
use dmprl_shared::segment::{
    LAYOUT_VERSION, Rejection, Segment, SegmentHeader, TRUNCATED, block_checksum,
};
use dmprl_shared::transport::delivery::{LogIdentity, Replayed, SegmentLog};
use rand::RngExt;

use super::*;
use crate::learner::LearnerError;
use crate::learner::tests::spec;
use crate::regime::Regime;

const RUN_ID: u64 = 5;

fn fresh() -> Result<Learner, LearnerError> {
    fresh_with(&[])
}

fn fresh_with(keys: &[(&str, &str)]) -> Result<Learner, LearnerError> {
    let mut layers = Layers::new();
    let common = [
        ("algorithm.name", "ddpg"),
        ("policy.normalise_observations", "false"),
        ("policy.hidden", "[16, 16]"),
        ("algorithm.critic_hidden", "[16, 16]"),
        ("algorithm.batch_size", "32"),
        ("exploration.warm_up_steps", "50"),
        ("replay.capacity_steps", "1000"),
        ("actors.workers", "1"),
        ("actors.envs_per_worker", "2"),
        ("checkpoint.keep", "2"),
    ];
    for (key, value) in common.iter().chain(keys) {
        layers.set("test", key, value).unwrap();
    }
    Learner::new(layers.finish().unwrap(), &spec(), RUN_ID)
}

fn segment(learner: &Learner, round: u32) -> Segment {
    let layout = learner.policy().layout();
    let mut random = dmprl_shared::seeds::stream(9, "segments", round.into());
    let mut segment = Segment::zeroed(layout);
    segment.block.iter_mut().for_each(|value| *value = random.random_range(-1.0..1.0));
    segment.header = SegmentHeader {
        layout_version: LAYOUT_VERSION,
        run_id: RUN_ID,
        architecture_hash: learner.policy().architecture_hash(),
        policy_version: learner.counters.policy_version,
        sequence: u64::from(round) + 1,
        env_index: round % 2,
        episode: round / 4,
        episode_step: round / 2 % 2 * 5,
        steps_len: 5,
        flags: if round / 2 % 2 == 1 { TRUNCATED } else { 0 },
        segment_steps: 5,
        observation_len: layout.observation_len as u32,
        action_len: layout.action_len as u32,
        checksum: block_checksum(&segment.block),
        ..SegmentHeader::default()
    };
    segment
}

/// Inserts `rounds` segments of two interleaved environments and does the updates owed for them.
fn train(learner: &mut Learner, rounds: std::ops::Range<u32>) {
    if learner.replay.is_empty() && learner.config().demonstrations.are_cloned() {
        learner.demonstrate(&[crate::demonstrations::tests::steps()]).unwrap();
    }
    for round in rounds {
        learner.insert(&segment(learner, round)).unwrap();
        let updates = learner.counters.updates;
        while learner.update_due() {
            learner.update().unwrap();
        }
        if matches!(learner.regime, Regime::OnPolicy(_)) && learner.counters.updates > updates {
            learner.next_snapshot().unwrap();
        }
    }
}

/// Writes a checkpoint and waits for it.
fn save(folder: &Path, learner: &mut Learner) -> Result<String, CheckpointError> {
    let mut writer = Writer::new(folder.to_owned());
    writer.begin(learner)?;
    writer.wait(learner).unwrap().result
}

fn checkpoint_bytes(folder: &Path, name: &str) -> Vec<(String, Vec<u8>)> {
    [NETWORKS, REPLAY, STATE]
        .iter()
        .map(|file| ((*file).to_owned(), fs::read(folder.join(name).join(file)).unwrap()))
        .collect()
}

#[test]
fn a_resumed_learner_goes_on_to_the_same_bytes_as_one_that_never_stopped() {
    for keys in [
        &[][..],
        &[("algorithm.name", "td3"), ("policy.normalise_observations", "true")],
        &[("algorithm.name", "sac"), ("policy.normalise_observations", "true")],
        &[("algorithm.name", "tqc"), ("policy.normalise_observations", "true")],
        &[("learner.backend", "graph"), ("policy.normalise_observations", "true")],
        &[("algorithm.critic_layer_norm", "true"), ("policy.normalise_observations", "true")],
        &[("demonstrations.files", "['some.npz']"), ("policy.normalise_observations", "true")],
    ] {
        let fresh = || fresh_with(keys);
        let folder = tempfile::tempdir().unwrap();
        let (straight, resumed) = (folder.path().join("straight"), folder.path().join("resumed"));
        [&straight, &resumed].into_iter().for_each(|path| fs::create_dir(path).unwrap());

        let mut learner = fresh().unwrap();
        train(&mut learner, 0..60);
        save(&resumed, &mut learner).unwrap();
        train(&mut learner, 60..300);
        let name = save(&straight, &mut learner).unwrap();
        assert!(learner.counters.updates > 400);

        let (mut learner, loaded) = load_newest(&resumed, &fresh).unwrap();
        assert!(loaded.rejected.is_empty());
        train(&mut learner, 60..300);
        let again = save(&resumed, &mut learner).unwrap();
        let both = [(&straight, &name), (&resumed, &again)];
        let [straight, resumed] = both.map(|(folder, name)| checkpoint_bytes(folder, name));
        assert!(straight == resumed, "{keys:?}");
    }
}

#[test]
fn the_saved_policy_is_an_average_and_workers_get_the_newest_one() {
    let normalised = ("policy.normalise_observations", "true");
    let fresh = |share| fresh_with(&[("learner.average_share", share), normalised]).unwrap();
    let (mut learner, mut plain) = (fresh("0.1"), fresh("0"));
    let mut expected = vec![0.0; learner.policy().parameters_len()];
    for round in 0..60 {
        learner.insert(&segment(&learner, round)).unwrap();
        plain.insert(&segment(&plain, round)).unwrap();
        while learner.update_due() {
            learner.update().unwrap();
            plain.update().unwrap();
            let policy = plain.next_snapshot().unwrap().values.clone();
            assert_eq!(learner.next_snapshot().unwrap().values, policy);
            if learner.counters.updates.is_multiple_of(4) {
                // The first policy counts alone, the n-th with 1 / (1 + 0.1 (n - 1)).
                let weight = 1.0 / (1.0 + 0.1 * (learner.counters.updates / 4 - 1) as f64);
                for (average, value) in expected.iter_mut().zip(policy) {
                    *average += weight * (f64::from(value) - *average);
                }
            }
        }
    }
    let saved = learner.saved_snapshot();
    assert!(saved.values.iter().zip(&expected).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-5));
}

#[test]
fn a_checkpoint_without_an_average_is_resumed() {
    let folder = tempfile::tempdir().unwrap();
    let mut learner = fresh_with(&[("learner.average_share", "0")]).unwrap();
    train(&mut learner, 0..60);
    save(folder.path(), &mut learner).unwrap();
    let (mut learner, _) = load_newest(folder.path(), &|| fresh_with(&[])).unwrap();
    train(&mut learner, 60..120);
    assert!(!learner.average.unwrap().values().is_empty());
}

#[test]
fn a_checkpoint_is_of_its_moment_however_far_training_goes_while_it_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let (at_once, later) = (folder.path().join("at_once"), folder.path().join("later"));
    [&at_once, &later].into_iter().for_each(|path| fs::create_dir(path).unwrap());
    let mut learner = fresh_with(&[("policy.normalise_observations", "true")]).unwrap();
    train(&mut learner, 0..150);
    let contents = CheckpointContents::capture(&mut learner).unwrap();
    let name = save(&at_once, &mut learner).unwrap();
    // This overwrites all 200 slots of the ring.
    train(&mut learner, 150..400);
    assert_eq!(contents.write(&later).unwrap(), name);
    assert!(checkpoint_bytes(&at_once, &name) == checkpoint_bytes(&later, &name));
}

#[test]
fn a_checkpoint_that_is_begun_is_there_when_its_writer_is_gone() {
    let folder = tempfile::tempdir().unwrap();
    let mut learner = fresh().unwrap();
    train(&mut learner, 0..60);
    let mut writer = Writer::new(folder.path().to_owned());
    writer.begin(&mut learner).unwrap();
    assert!(writer.is_busy());
    drop(writer);
    assert_eq!(names(folder.path()).unwrap(), ["000001"]);
    assert!(load_newest(folder.path(), &fresh).is_ok());
}

#[test]
fn a_checkpoint_of_the_format_before_is_read_and_one_of_a_later_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut learner = fresh().unwrap();
    train(&mut learner, 0..60);
    let name = save(folder, &mut learner).unwrap();
    let path = folder.join(&name).join(STATE);
    let mut state: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    let steps = state.as_object_mut().unwrap().remove("adam_steps").unwrap();
    state.as_object_mut().unwrap().remove("crc32");
    state["format_version"] = 1.into();
    for name in ["actor", "critic"] {
        state[format!("{name}_adam_step")] = steps[name].clone();
    }
    fs::write(&path, state.to_string()).unwrap();
    let (loaded, _) = load_newest(folder, &fresh).unwrap();
    assert_eq!(loaded.counters, learner.counters);
    assert_eq!(loaded.networks()[0].1.adam, learner.networks()[0].1.adam);

    state["format_version"] = 4.into();
    fs::write(&path, state.to_string()).unwrap();
    let error = load_newest(folder, &fresh).map(drop).unwrap_err().to_string();
    assert!(error.contains("format version 4, this build reads 1 to 3"), "{error}");
}

/// Earlier versions did not check `state.json` itself, only the files that it lists.
#[test]
fn a_number_that_was_changed_in_the_state_is_noticed() {
    let folder = tempfile::tempdir().unwrap();
    let mut learner = fresh().unwrap();
    train(&mut learner, 0..20);
    let name = save(folder.path(), &mut learner).unwrap();
    let path = folder.path().join(&name).join(STATE);
    let sound: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    let refused = |state: &serde_json::Value, why: &str| {
        fs::write(&path, state.to_string()).unwrap();
        let error = load_newest(folder.path(), &fresh).map(drop).unwrap_err().to_string();
        assert!(error.contains(why), "{error}");
    };
    let mut other = sound.clone();
    other["counters"]["env_steps"] = 101.into();
    refused(&other, "CRC-32");
    other.as_object_mut().unwrap().remove("crc32");
    refused(&other, "CRC-32");
    // A format without CRC-32 is still checked for impossible values.
    other["format_version"] = 2.into();
    for (key, value) in [("updates_owed", 1e300.into()), ("updates_owed", (-1.0).into())] {
        let mut other = other.clone();
        other[key] = value;
        refused(&other, "updates_owed is");
    }
    other["counters"]["env_steps"] = u64::MAX.into();
    refused(&other, "a counter is");
}

#[test]
fn segments_of_a_checkpoint_are_rejected_and_missing_ones_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let mut learner = fresh().unwrap();
    train(&mut learner, 0..60);
    save(folder.path(), &mut learner).unwrap();
    train(&mut learner, 60..70);
    let (mut learner, _) = load_newest(folder.path(), &fresh).unwrap();
    assert_eq!(learner.inbox.settled()[0], Watermark { incarnation: 0, sequence: 60 });
    let again = segment(&learner, 59);
    assert_eq!(learner.insert(&again), Err(Rejection::Duplicate));
    // The worker no longer has ten segments that the crashed learner had acknowledged.
    train(&mut learner, 70..71);
    let counters = learner.counters;
    assert_eq!((counters.segments, counters.lost, counters.received), (61, 10, 62));
}

#[test]
fn at_level_log_what_was_acknowledged_outlives_the_learner() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("segments.log");
    let checkpoints = folder.path().join("checkpoints");
    fs::create_dir(&checkpoints).unwrap();
    let fresh = || fresh_with(&[("delivery.level", "log")]);
    let open = |learner: &Learner| {
        let architecture_hash = learner.policy().architecture_hash();
        let identity = LogIdentity { run_id: RUN_ID, architecture_hash };
        SegmentLog::open(&path, identity, learner.policy().layout(), 1 << 20).unwrap()
    };
    let mut learner = fresh().unwrap();
    assert_eq!(learner.recover(open(&learner)).unwrap(), Replayed::default());
    train(&mut learner, 0..60);
    save(&checkpoints, &mut learner).unwrap();
    train(&mut learner, 60..80);
    let marks = learner.inbox.acknowledge().unwrap();
    assert_eq!(marks[0], Watermark { incarnation: 0, sequence: 80 });
    let mut replay = Vec::new();
    learner.replay.write(&mut replay).unwrap();
    train(&mut learner, 80..85);
    drop(learner);

    let (mut learner, _) = load_newest(&checkpoints, &fresh).unwrap();
    assert_eq!(learner.counters.segments, 60);
    let replayed = learner.recover(open(&learner)).unwrap();
    assert_eq!(replayed, Replayed { records: 20, cut_bytes: 0 });
    assert_eq!((learner.counters.segments, learner.counters.lost), (80, 0));
    let mut recovered = Vec::new();
    learner.replay.write(&mut recovered).unwrap();
    assert!(recovered == replay, "the same segments in the same order");
    // The worker still has the last five and retransmits them.
    train(&mut learner, 80..85);
    assert_eq!(learner.counters.lost, 0);
    save(&checkpoints, &mut learner).unwrap();
    let (mut learner, _) = load_newest(&checkpoints, &fresh).unwrap();
    assert_eq!(learner.recover(open(&learner)).unwrap(), Replayed::default(), "emptied");
}

#[test]
fn normalisation_that_was_switched_on_or_off_since_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut learner = fresh().unwrap();
    train(&mut learner, 0..4);
    save(folder.path(), &mut learner).unwrap();
    let switched = || fresh_with(&[("policy.normalise_observations", "true")]);
    let error = load_newest(folder.path(), &switched).map(drop).unwrap_err().to_string();
    assert!(error.contains("policy.normalise_observations"), "{error}");
}

#[test]
fn an_on_policy_learner_goes_on_from_its_networks_with_an_empty_rollout() {
    let fresh = || {
        fresh_with(&[
            ("algorithm.name", "ndp"),
            ("exploration.warm_up_steps", "0"),
            ("algorithm.ndp.rollout_segments", "8"),
            ("algorithm.ndp.minibatches", "2"),
            ("algorithm.ndp.epochs", "2"),
            ("policy.normalise_observations", "true"),
        ])
    };
    let policy = |learner: &mut Learner| learner.next_snapshot().unwrap().values.clone();
    let folder = tempfile::tempdir().unwrap();
    let mut learner = fresh().unwrap();
    learner.next_snapshot().unwrap();
    train(&mut learner, 0..20);
    assert_eq!((learner.counters.updates, learner.counters.stale_segments), (8, 0));
    let rollout = |learner: &Learner| learner.regime.segments_held(&learner.replay);
    assert_eq!(rollout(&learner), 4);
    save(folder.path(), &mut learner).unwrap();

    let resume = || load_newest(folder.path(), &fresh).unwrap().0;
    let mut resumed = resume();
    assert_eq!((resumed.counters, rollout(&resumed)), (learner.counters, 0));
    for ((name, old), (_, new)) in learner.networks().iter().zip(resumed.networks()) {
        assert_eq!(old.adam, new.adam, "{name}");
    }
    assert_eq!(policy(&mut resumed), policy(&mut learner));
    let mut again = resume();
    policy(&mut again);
    for learner in [&mut resumed, &mut again] {
        train(learner, 20..60);
        assert_eq!(learner.counters.updates, 8 + 5 * 4);
    }
    assert_eq!(policy(&mut resumed), policy(&mut again));
}

#[test]
fn a_damaged_checkpoint_is_refused_with_the_reason_and_the_one_before_is_used() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut learner = fresh().unwrap();
    train(&mut learner, 0..60);
    let older = save(folder, &mut learner).unwrap();
    train(&mut learner, 60..80);
    let newer = save(folder, &mut learner).unwrap();

    type Damage = dyn Fn(&mut Vec<u8>);
    let damages: [(&str, &Damage, &str); 5] = [
        (REPLAY, &|bytes| bytes.truncate(100), "length in bytes is 100"),
        (REPLAY, &|bytes| bytes[300] ^= 1, "CRC-32"),
        (NETWORKS, &|bytes| *bytes.last_mut().unwrap() ^= 1, "CRC-32"),
        (STATE, &|bytes| bytes.truncate(20), "EOF"),
        (STATE, &|bytes| *bytes = b"\x80\x04}q\x00.".to_vec(), "expected value"),
    ];
    for (file, damage, reason) in damages {
        let path = folder.join(&newer).join(file);
        let sound = fs::read(&path).unwrap();
        let mut bytes = sound.clone();
        damage(&mut bytes);
        fs::write(&path, bytes).unwrap();
        let (_, loaded) = load_newest(folder, &fresh).unwrap();
        assert_eq!(loaded.name, older);
        let refused = loaded.rejected[0].to_string();
        assert!(refused.contains(reason), "{file}: {refused}");
        fs::write(&path, sound).unwrap();
    }
    assert_eq!(load_newest(folder, &fresh).unwrap().1.name, newer);
}

#[test]
fn networks_that_are_not_finite_are_not_written_and_the_error_names_the_parameter() {
    let folder = tempfile::tempdir().unwrap();
    let mut learner = fresh().unwrap();
    train(&mut learner, 0..40);
    let name = save(folder.path(), &mut learner).unwrap();
    learner
        .for_each_network(|name, network| {
            if name == "critic" {
                network.adam.moments.second[3] = f32::INFINITY;
            }
            Ok::<(), LearnerError>(())
        })
        .unwrap();
    let error = save(folder.path(), &mut learner).unwrap_err();
    assert!(matches!(error, CheckpointError::NotFinite { .. }));
    let message = error.to_string();
    assert!(message.contains("critic.adam_second[3] is inf"), "{message}");
    assert_eq!(names(folder.path()).unwrap(), [name]);
}

#[test]
fn policy_that_is_not_finite_is_not_published() {
    let mut learner = fresh().unwrap();
    learner
        .for_each_network(|name, network| {
            if name == "actor" {
                network.parameters.values_mut()[7] = f32::NAN;
            }
            Ok::<(), LearnerError>(())
        })
        .unwrap();
    let message = learner.next_snapshot().unwrap_err().to_string();
    assert!(message.contains("policy[7] is NaN"), "{message}");
}

#[test]
fn checkpoint_that_is_not_finite_is_rejected_and_the_one_before_is_used() {
    let folder = tempfile::tempdir().unwrap();
    let mut learner = fresh().unwrap();
    train(&mut learner, 0..40);
    let finite = save(folder.path(), &mut learner).unwrap();
    train(&mut learner, 40..60);
    // As an older version could have written it, with valid checksums.
    let mut contents = CheckpointContents::capture(&mut learner).unwrap();
    let end = contents.networks.len();
    contents.networks[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    contents.write(folder.path()).unwrap();
    let (loaded_learner, loaded) = load_newest(folder.path(), &fresh).unwrap();
    assert_eq!(loaded.name, finite);
    assert!(loaded_learner.counters.updates < learner.counters.updates);
    let reason = loaded.rejected[0].to_string();
    assert!(reason.contains("is NaN, expected a finite number"), "{reason}");
}

#[test]
fn a_half_written_checkpoint_is_never_taken_and_is_swept_away() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut learner = fresh().unwrap();
    let name = save(folder, &mut learner).unwrap();
    let torn = folder.join(".000002.tmp");
    fs::create_dir(&torn).unwrap();
    fs::write(torn.join(REPLAY), b"half").unwrap();
    // The evaluator's: without this file, its link to the best policy could not be replaced.
    let other = folder.join(".aside-1.tmp");
    fs::write(&other, b"").unwrap();
    assert_eq!(load_newest(folder, &fresh).unwrap().1.name, name);
    assert_eq!(save(folder, &mut learner).unwrap(), "000002");
    assert!(!torn.exists() && other.exists());
}

#[test]
fn the_oldest_make_room_and_latest_points_at_the_newest() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut learner = fresh().unwrap();
    let saved: Vec<String> = (0..4).map(|_| save(folder, &mut learner).unwrap()).collect();
    assert_eq!(names(folder).unwrap(), saved[2..]);
    assert_eq!(fs::read_link(folder.join("latest")).unwrap(), Path::new(&saved[3]));
    // In a copy made without symbolic links, `latest` is a directory.
    fs::remove_file(folder.join("latest")).unwrap();
    fs::create_dir(folder.join("latest")).unwrap();
    rotation::point_latest(folder, &saved[3]).unwrap();
    assert_eq!(fs::read_link(folder.join("latest")).unwrap(), Path::new(&saved[3]));
    rotation::rotate(folder, 2, 1).unwrap();
    assert_eq!(names(folder).unwrap(), saved[3..], "the newest stays whatever the disk cap");
}

#[test]
fn a_folder_that_cannot_be_written_keeps_its_old_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let mut learner = fresh().unwrap();
    let name = save(folder.path(), &mut learner).unwrap();
    // A missing folder fails for root, too, unlike permissions.
    let blocked = folder.path().join(".000002.tmp");
    fs::create_dir(&blocked).unwrap();
    let contents = CheckpointContents::capture(&mut learner).unwrap();
    let failed = contents.write_files(&folder.path().join("missing")).unwrap_err();
    assert!(failed.to_string().contains("missing"), "{failed}");
    assert_eq!(load_newest(folder.path(), &fresh).unwrap().1.name, name);
}

#[test]
fn no_checkpoint_at_all_is_an_error_that_lists_why() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("000001")).unwrap();
    let error = load_newest(folder.path(), &fresh).unwrap_err().to_string();
    assert!(error.contains("no usable checkpoint") && error.contains(STATE), "{error}");
}
