//! Checkpoints with damaged files, with and without matching checksums.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use dmprl_learner::checkpoint::{CheckpointContents, load_newest};
use dmprl_learner::learner::{Learner, LearnerError};
use serde_json::Value;

use crate::fixture;
use crate::mutate::{self, Random};
use crate::{Target, Verdict};

const STATE: &str = "state.json";
const REPLAY: &str = "replay.bin";
/// Bytes in front of a replay's slots, which have 8 bytes each, beginning with the successor.
const REPLAY_HEAD: usize = 80;
const NETWORKS: &str = "networks.safetensors";
/// Number of updates from an accepted checkpoint, which must be usable.
const UPDATES: usize = 2;

/// Keys of a run whose checkpoints have the most content.
type Keys = &'static [(&'static str, &'static str)];
const RUNS: [Keys; 2] = [
    &[("policy.normalise_observations", "true")],
    &[("algorithm.name", "sac"), ("policy.kind", "mlp"), ("policy.start", "zero")],
];

/// Files of a checkpoint by name.
type Files = BTreeMap<String, Vec<u8>>;

fn write(learner: &mut Learner, folder: &Path) -> Files {
    let name = CheckpointContents::capture(learner).unwrap().write(folder).unwrap();
    let entries = fs::read_dir(folder.join(name)).unwrap().flatten();
    let read = |path: &Path| fs::read(path).unwrap();
    entries.map(|entry| (entry.file_name().into_string().unwrap(), read(&entry.path()))).collect()
}

/// Checkpoints of one run at two times.
fn checkpoints(keys: Keys, folder: &Path) -> [Files; 2] {
    let mut random = Random::new(dmprl_shared::seeds::stream(1, "checkpoints", 0));
    let mut learner = fixture::learner(keys).unwrap();
    let mut number = 0;
    // The second one after the ring has wrapped around.
    [20, 230].map(|segments| {
        for _ in 0..segments {
            let segment = fixture::segment(&mut random, &learner, number);
            learner.insert(&segment).unwrap();
            number += 1;
            if learner.update_due() {
                learner.update().unwrap();
            }
        }
        write(&mut learner, folder)
    })
}

/// Writes the checksums of the files, and none of itself, into `state.json`, as older versions did,
/// so that damage passes the checksums.
fn repair(files: &mut Files) {
    let Ok(mut state) = serde_json::from_slice::<Value>(&files[STATE]) else { return };
    for sum in state.get_mut("files").and_then(Value::as_array_mut).into_iter().flatten() {
        let Some(sum) = sum.as_object_mut() else { continue };
        let name = sum.get("name").and_then(Value::as_str);
        let Some(file) = name.and_then(|name| files.get(name)) else { continue };
        sum.insert("bytes".into(), file.len().into());
        sum.insert("crc32".into(), crc32fast::hash(file).into());
    }
    if let Some(fields) = state.as_object_mut() {
        fields.remove("crc32");
        if fields.get("format_version").and_then(Value::as_u64) == Some(3) {
            fields.insert("format_version".into(), 2.into());
        }
    }
    files.insert(STATE.into(), serde_json::to_vec(&state).unwrap());
}

/// Changes one file or two.
fn damage(random: &mut Random, files: &mut Files, other: &Files) {
    for _ in 0..=random.below(2) {
        match random.below(9) {
            0..3 => {
                if let Ok(mut state) = serde_json::from_slice(&files[STATE]) {
                    mutate::json(random, &mut state);
                    files.insert(STATE.into(), serde_json::to_vec(&state).unwrap());
                }
            }
            // The counts at its beginning determine how the rest is read.
            3 => overwrite_count(random, files.get_mut(REPLAY).unwrap()),
            4 => overwrite_count(random, files.get_mut(NETWORKS).unwrap()),
            // A slot's successor, from which a window takes its second half.
            5 => {
                let replay = files.get_mut(REPLAY).unwrap();
                let (at, number) = (REPLAY_HEAD + 8 * random.below(240), random.number() as u32);
                if let Some(word) = replay.get_mut(at..at + 4) {
                    word.copy_from_slice(&number.to_le_bytes());
                }
            }
            6 => drop(files.insert(REPLAY.into(), other[REPLAY].clone())),
            _ => {
                let name = *random.pick(&[STATE, REPLAY, REPLAY, NETWORKS]);
                mutate::bytes(random, files.get_mut(name).unwrap(), &other[name]);
            }
        }
    }
}

/// Overwrites one of the first 64-bit words.
fn overwrite_count(random: &mut Random, file: &mut [u8]) {
    let at = 8 * random.below(12);
    let number = random.number().to_le_bytes();
    if let Some(word) = file.get_mut(at..at + 8) {
        word.copy_from_slice(&number);
    }
}

fn lay(files: &Files, folder: &Path) {
    let path = folder.join("000001");
    fs::create_dir_all(&path).unwrap();
    for (name, bytes) in files {
        fs::write(path.join(name), bytes).unwrap();
    }
}

#[test]
fn one_that_is_accepted_can_be_gone_on_from_and_any_other_is_refused() {
    let target = Target {
        name: "checkpoint::one_that_is_accepted_can_be_gone_on_from_and_any_other_is_refused",
        cases: 800,
        // A buffer of 1 MiB for each file, and a learner.
        bytes_max: 16 << 20,
    };
    let folder = fixture::folder();
    let made = RUNS.map(|keys| {
        let path = folder.path().join("made");
        fs::create_dir_all(&path).unwrap();
        checkpoints(keys, &path)
    });
    let (there, again) = (folder.path().join("there"), folder.path().join("again"));
    target.fuzz(|random| {
        let run = random.below(RUNS.len());
        let (one, other) = (random.below(2), random.below(2));
        let mut files = made[run][one].clone();
        damage(random, &mut files, &made[run][other]);
        let repaired = !random.once_in(4);
        if repaired {
            repair(&mut files);
        }
        for path in [&there, &again] {
            let _ = fs::remove_dir_all(path);
            fs::create_dir_all(path).unwrap();
        }
        lay(&files, &there);
        let loaded = load_newest(&there, &|| fixture::learner(RUNS[run]));
        let verdict = Verdict::of(&loaded);
        if let Ok((learner, _)) = loaded {
            let written = go_on(random, learner, RUNS[run], &again);
            assert!(repaired || written == made[run][one], "damage that the checksums show");
        }
        verdict
    });
}

/// An accepted checkpoint is written again unchanged, and trains.
fn go_on(random: &mut Random, mut learner: Learner, keys: Keys, folder: &Path) -> Files {
    let first = write(&mut learner, folder);
    let (mut copy, _) = load_newest(folder, &|| fixture::learner(keys)).unwrap();
    assert_eq!(write(&mut copy, folder), first, "written, read and written again");
    for number in 0..4 {
        let mut segment = fixture::segment(random, &learner, number);
        segment.header.incarnation = u32::MAX;
        // Its counters may be at their limits.
        let _ = learner.insert(&segment);
    }
    for slot in 0..learner.replay.len() {
        for offset in 0..learner.replay.layout().segment_steps {
            if let Some(window) = learner.replay.window(slot, offset) {
                let _ = learner.replay.last_observation(&window);
                let _ = learner.replay.discounted_reward(&window, 0.9);
            }
        }
    }
    for _ in 0..UPDATES {
        // A number that is not finite ends the run, with the name of its tensor.
        if learner.update().is_err() {
            break;
        }
    }
    let _ = learner.metrics_line();
    // After an update of extreme values. Such parameters are not published.
    if let Err(error) = learner.next_snapshot() {
        assert!(matches!(error, LearnerError::NotFiniteParameter { .. }), "{error}");
    }
    first
}
