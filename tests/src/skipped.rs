//! Records skipped tests, for the list at the end of a test run.
//!
//! `tests/what_was_skipped.rs`, which cargo runs last, prints the list. This file uses nothing else
//! of its crate, because unit tests of crates that `dmprl-tests` depends on include it by its path.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Records and prints that a test was skipped.
///
/// - `required_by`: environment variable that turns this skip into a failure.
/// - `what`: the part that is not tested.
/// - `remedy`: the command or condition that would test it.
///
/// # Panics
/// If `required_by` is set, or if the record cannot be written.
pub fn skipped(required_by: &str, what: &str, remedy: &str) {
    let required = std::env::var_os(required_by).is_some();
    assert!(!required, "{required_by} is set, but {what} cannot be tested; {remedy}");
    append(&file_of_this_run(), what, remedy);
    // Not `eprintln!`: the test harness captures it.
    let _ = writeln!(std::io::stderr().lock(), "skipped: {what}; to test it: {remedy}");
}

/// Appends one record. A single write in append mode: records of processes that write at the same
/// time do not mix.
pub(crate) fn append(file: &Path, what: &str, remedy: &str) {
    let record = serde_json::json!({ "what": what, "remedy": remedy });
    let written = fs::create_dir_all(file.parent().expect("a file in a folder"))
        .and_then(|()| OpenOptions::new().create(true).append(true).open(file))
        .and_then(|mut file| file.write_all(format!("{record}\n").as_bytes()));
    written.unwrap_or_else(|error| panic!("{}: {error}", file.display()));
}

/// Returns the records of this test run, below `target/<profile>/skipped-tests`.
///
/// All test processes of one `cargo test` are children of that cargo, so its process identifies the
/// run. Each run thus starts with an empty list, and concurrent runs do not share one.
pub(crate) fn file_of_this_run() -> PathBuf {
    let test = std::env::current_exe().expect("a test knows its executable");
    let profile = test.parent().and_then(Path::parent).expect("target/<profile>/deps/<test>");
    let cargo = std::os::unix::process::parent_id();
    let name = format!("{cargo}-{}.jsonl", start_ticks(cargo).unwrap_or_default());
    profile.join("skipped-tests").join(name)
}

/// Returns the start time of a process [clock ticks since boot], which distinguishes it from a
/// later one with the same id; `None` if it has ended.
pub(crate) fn start_ticks(process: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // Field 22; field 2 is the name, which may contain spaces and parentheses.
    let (_, after_name) = stat.rsplit_once(')')?;
    after_name.split_whitespace().nth(19)?.parse().ok()
}
