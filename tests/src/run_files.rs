//! Reads the files that a run leaves behind.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use serde_json::Value;

/// Every whole line of a `.jsonl` file of a run.
///
/// # Panics
/// When a line is no JSON.
pub fn rows(run: &str, file: &str) -> Vec<Value> {
    let text = fs::read_to_string(Path::new(run).join(file)).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    let parse = |line| {
        serde_json::from_str(line).unwrap_or_else(|error| panic!("{run}/{file}: {error}: {line}"))
    };
    whole.lines().map(parse).collect()
}

/// `env_steps` of each row.
pub fn env_steps(rows: &[Value]) -> Vec<u64> {
    rows.iter().filter_map(|row| row["env_steps"].as_u64()).collect()
}

/// Where the last line of `metrics.jsonl` stands.
pub fn env_steps_of(run: &str) -> Option<u64> {
    env_steps(&rows(run, "metrics.jsonl")).last().copied()
}

/// A JSON file of a run, null when it is not there or not whole.
pub fn json_file(run: &str, file: &str) -> Value {
    let bytes = fs::read(Path::new(run).join(file)).unwrap_or_default();
    serde_json::from_slice(&bytes).unwrap_or(Value::Null)
}

/// Environment steps of the checkpoint that a resume goes on from.
pub fn env_steps_of_checkpoint(run: &str) -> Option<u64> {
    json_file(run, "checkpoints/latest/state.json")["counters"]["env_steps"].as_u64()
}

/// What lies in shared memory for a run: its domains, whole or half-made or half-removed.
///
/// # Panics
/// When the run has no manifest.
pub fn shared_memory_of(run: &str) -> Vec<PathBuf> {
    let manifest = json_file(run, "manifest.json");
    shared_memory_named(manifest["run_id"].as_str().expect("a manifest with a run_id"))
}

/// What lies in this user's shared memory with `text` in its name: a run's id is, and at the name's
/// end the id of the process that made it.
pub fn shared_memory_named(text: &str) -> Vec<PathBuf> {
    let user = fs::metadata("/proc/self").map_or(0, |metadata| metadata.uid());
    let Ok(entries) = fs::read_dir(format!("/dev/shm/dmprl-{user}")) else { return Vec::new() };
    let named = |path: &PathBuf| path.to_string_lossy().contains(text);
    entries.flatten().map(|entry| entry.path()).filter(named).collect()
}
