//! `dmprl bench` in rounds too short for meaningful figures.

mod learner;
mod peers;
mod policy;
mod rollout;
mod scale;
mod system;
mod transport;

use std::path::PathBuf;
use std::process::Command;

use dmprl_tests::program::{Running, Workplace, executable, shared_memory_named};
use rustix::process::Pid;
use serde_json::Value;

/// Settings of small networks that learn soon.
const SMALL: [&str; 8] = [
    "--set",
    "policy.hidden=[16]",
    "--set",
    "algorithm.critic_hidden=[16]",
    "--set",
    "algorithm.batch_size=16",
    "--set",
    "exploration.warm_up_steps=200",
];

/// Starts a benchmark with its temporary files in the test's folder.
fn start(place: &Workplace, arguments: &[&str]) -> Running {
    let temporary = place.path("tmp");
    std::fs::create_dir_all(&temporary).unwrap();
    let mut command = Command::new(executable());
    command.arg("bench").args(arguments).env("TMPDIR", temporary);
    place.start_command(command)
}

fn assert_no_temporary_files(place: &Workplace) {
    assert_eq!(std::fs::read_dir(place.path("tmp")).unwrap().count(), 0, "temporary files");
}

/// The names of a benchmark's shared memory end in its process id.
fn assert_no_shared_memory(benchmark: Pid) {
    let end = format!("-{}", benchmark.as_raw_nonzero());
    let mut left = shared_memory_named(&end);
    // A longer number would have the same beginning.
    left.retain(|path| path.to_string_lossy().ends_with(&end));
    assert_eq!(left, Vec::<PathBuf>::new());
}

fn assert_positive(json: &Value, key: &str) {
    assert!(json[key].as_f64() > Some(0.0), "{key} is {}: {json}", json[key]);
}
