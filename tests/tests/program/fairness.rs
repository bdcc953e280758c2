//! Shares of workers in a learner that is slower than they are.

use std::fs;
use std::path::Path;

use dmprl_tests::program::Workplace;
use serde_json::Value;

use crate::train;

const WORKERS: usize = 4;

/// Returns the number of segments of each worker at each checkpoint, oldest first.
fn settled(run: &str) -> Vec<Vec<u64>> {
    let folder = fs::read_dir(Path::new(run).join("checkpoints")).unwrap();
    let mut states: Vec<_> = folder
        .flatten()
        .map(|entry| entry.path().join("state.json"))
        .filter(|path| path.exists())
        .collect();
    states.sort();
    let read = |path| -> Vec<u64> {
        let state: Value = serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap();
        let marks = state["settled"].as_array().unwrap();
        marks[..WORKERS].iter().map(|mark| mark["sequence"].as_u64().unwrap()).collect()
    };
    states.into_iter().map(read).collect()
}

/// 50 updates per segment make the learner several times slower than one worker.
#[test]
fn workers_share_a_slow_learner_evenly() {
    let place = Workplace::new();
    let run = place.path("run");
    let more = [
        ["--workers", "4"],
        ["--envs-per-worker", "2"],
        ["--steps", "8000"],
        ["--set", "pacing.updates_per_segment=50"],
        ["--set", "checkpoint.keep=100"],
        ["--set", "actors.joined_max=0"],
    ];
    place.run(&train("reacher", &run, &more.concat())).with_status(0);
    let settled = settled(&run);
    // From the first checkpoint that contains all of them to the last.
    let first = settled.iter().find(|counts| counts.iter().all(|&count| count > 0)).unwrap();
    let last = settled.last().unwrap();
    let shares: Vec<u64> = last.iter().zip(first).map(|(last, first)| last - first).collect();
    let (least, most) = (shares.iter().min().unwrap(), shares.iter().max().unwrap());
    println!("segments of each worker: {shares:?}");
    assert!(*least >= 100, "too few to compare: {shares:?} of {settled:?}");
    assert!(*most as f64 <= 1.5 * *least as f64, "{shares:?}");
}
