//! Reads the files that a run leaves behind.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use serde_json::Value;

/// Returns the complete lines of a run's `.jsonl` file.
///
/// # Panics
/// If a line is not JSON.
pub fn rows(run: &str, file: &str) -> Vec<Value> {
    let text = fs::read_to_string(Path::new(run).join(file)).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    let parse = |line| {
        serde_json::from_str(line).unwrap_or_else(|error| panic!("{run}/{file}: {error}: {line}"))
    };
    whole.lines().map(parse).collect()
}

/// Returns `env_steps` of each row.
pub fn env_steps(rows: &[Value]) -> Vec<u64> {
    rows.iter().filter_map(|row| row["env_steps"].as_u64()).collect()
}

/// Returns `env_steps` of the last line of `metrics.jsonl`.
pub fn env_steps_of(run: &str) -> Option<u64> {
    env_steps(&rows(run, "metrics.jsonl")).last().copied()
}

/// Returns a JSON file of a run, or null if it is missing or incomplete.
pub fn json_file(run: &str, file: &str) -> Value {
    let bytes = fs::read(Path::new(run).join(file)).unwrap_or_default();
    serde_json::from_slice(&bytes).unwrap_or(Value::Null)
}

/// Returns the environment steps of the checkpoint from which a resume would continue.
pub fn env_steps_of_checkpoint(run: &str) -> Option<u64> {
    json_file(run, "checkpoints/latest/state.json")["counters"]["env_steps"].as_u64()
}

/// Returns the files of a run in shared memory: its domains, including partly made or removed ones.
///
/// # Panics
/// If the run has no manifest.
pub fn shared_memory_of(run: &str) -> Vec<PathBuf> {
    let manifest = json_file(run, "manifest.json");
    shared_memory_named(manifest["run_id"].as_str().expect("a manifest with a run_id"))
}

/// Returns this user's files in shared memory whose names contain `text`. A name contains the run's
/// id, and ends with the id of the process that made it.
pub fn shared_memory_named(text: &str) -> Vec<PathBuf> {
    let user = fs::metadata("/proc/self").map_or(0, |metadata| metadata.uid());
    let Ok(entries) = fs::read_dir(format!("/dev/shm/dmprl-{user}")) else { return Vec::new() };
    let named = |path: &PathBuf| path.to_string_lossy().contains(text);
    entries.flatten().map(|entry| entry.path()).filter(named).collect()
}
