//! `--deterministic`: the same seed gives the same bytes.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use dmprl_learner::metrics::TIME_KEYS;
use dmprl_tests::program::{Workplace, rows};
use dmprl_tests::tiny_envs_dir;
use serde_json::Value;

use crate::train;

/// Returns everything that must repeat: rows without times, and the newest checkpoint's files.
#[derive(Debug, PartialEq)]
struct Result {
    metrics: Vec<Value>,
    evaluations: Vec<Value>,
    checkpoint: BTreeMap<String, Vec<u8>>,
}

fn trained(place: &Workplace, name: &str, seed: &str, more: &[&str]) -> Result {
    trained_on("reacher", place, name, &[&["--seed", seed], more].concat())
}

fn trained_on(task: &str, place: &Workplace, name: &str, more: &[&str]) -> Result {
    let run = place.path(name);
    let more = [&["--deterministic", "--steps", "2500"], more].concat();
    place.run(&train(task, &run, &more)).with_status(0);
    let timeless = |file| {
        let mut rows = rows(&run, file);
        for row in &mut rows {
            TIME_KEYS.iter().for_each(|key| drop(row.as_object_mut().unwrap().remove(*key)));
        }
        rows
    };
    let latest = Path::new(&run).join("checkpoints/latest");
    let files = fs::read_dir(&latest).unwrap().map(|entry| entry.unwrap());
    Result {
        metrics: timeless("metrics.jsonl"),
        evaluations: timeless("evaluations.jsonl"),
        checkpoint: files
            .map(|file| (file.file_name().into_string().unwrap(), fs::read(file.path()).unwrap()))
            .collect(),
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_seed_does_not() {
    let place = Workplace::new();
    let first = trained(&place, "first", "7", &[]);
    assert_eq!((first.metrics.len(), first.evaluations.len(), first.checkpoint.len()), (5, 3, 3));
    let second = trained(&place, "second", "7", &[]);
    assert_eq!(first.metrics, second.metrics);
    assert_eq!(first.evaluations, second.evaluations);
    for (name, bytes) in &first.checkpoint {
        assert!(second.checkpoint[name] == *bytes, "{name} of the checkpoints differs");
    }
    let other = trained(&place, "other", "8", &[]);
    assert_ne!(first.evaluations, other.evaluations);
    for (name, bytes) in &first.checkpoint {
        assert!(other.checkpoint[name] != *bytes, "{name} does not depend on the seed");
    }
}

#[test]
fn on_policy_the_same_seed_gives_the_same_bytes_too() {
    let place = Workplace::new();
    let ndp = ["--algo", "ndp", "--set", "exploration.warm_up_steps=0"];
    let first = trained(&place, "first", "7", &ndp);
    let last = first.metrics.last().unwrap();
    assert!(last["updates"].as_u64() > Some(0), "{last}");
    assert!(first == trained(&place, "second", "7", &ndp));
}

/// With segments that start at the last action.
#[test]
fn with_graphs_the_same_seed_gives_the_same_bytes_too() {
    let place = Workplace::new();
    let mut more = vec!["--algo", "tqc", "--set", "pacing.updates_per_segment=0.2"];
    for pair in ["exploration.warm_up_steps=500", "algorithm.batch_size=64"] {
        more.extend(["--set", pair]);
    }
    more.extend(["--set", "policy.start=action", "--set", "policy.controller=direct"]);
    let first = trained(&place, "first", "7", &more);
    let last = first.metrics.last().unwrap();
    assert!(last["updates"].as_u64() > Some(0), "{last}");
    assert!(first == trained(&place, "second", "7", &more));
}

#[test]
fn with_randomised_physics_and_delays_the_same_seed_gives_the_same_bytes_too() {
    let place = Workplace::new();
    let more = ["mass=[0.5, 2.0]", "action_delay_steps=[0, 2]", "observation_delay_steps=[0, 2]"]
        .map(|pair| format!("task.randomise.{pair}"));
    let more: Vec<_> = more.iter().flat_map(|pair| ["--set", pair]).collect();
    let first = trained(&place, "first", "7", &more);
    assert!(first == trained(&place, "second", "7", &more));
    assert_ne!(first.evaluations, trained(&place, "nominal", "7", &[]).evaluations);
}

/// Its rewards follow a rule, so the learner draws goals from the random stream of its windows.
#[test]
fn with_goals_the_same_seed_gives_the_same_bytes_too() {
    let place = Workplace::new();
    let folder = tiny_envs_dir();
    let more = ["--preset", "goal", "--set", "exploration.warm_up_steps=500"];
    let more = [&more[..], &["--python-path", folder.to_str().unwrap()]].concat();
    let first = trained_on("tiny_envs:Reach-v0", &place, "first", &more);
    let last = first.metrics.last().unwrap();
    assert!(last["updates"].as_u64() > Some(0), "{last}");
    assert!(first == trained_on("tiny_envs:Reach-v0", &place, "second", &more));
}
