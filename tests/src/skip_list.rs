//! The list of skipped tests at the end of a test run.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::skipped::{file_of_this_run, start_ticks};

/// Prints the tests that were skipped in this run, with the command for each.
///
/// # Panics
/// If the records cannot be read.
pub fn print() {
    let file = file_of_this_run();
    let records = fs::read_to_string(&file).unwrap_or_default();
    print!("\n{}", text(&records));
    remove_ended_runs(file.parent().expect("a file in a folder"));
    let _ = fs::remove_file(file);
}

/// Returns the list, one entry per distinct record, in the order of first appearance.
fn text(records: &str) -> String {
    let mut entries: Vec<(Value, usize)> = Vec::new();
    for line in records.lines() {
        let record = serde_json::from_str(line)
            .unwrap_or_else(|error| panic!("a damaged record: {error}: {line}"));
        match entries.iter_mut().find(|(known, _)| *known == record) {
            Some((_, count)) => *count += 1,
            None => entries.push((record, 1)),
        }
    }
    if entries.is_empty() {
        return "Nothing was skipped in this test run.\n".to_owned();
    }
    let mut text = "Skipped in this test run:\n".to_owned();
    for (record, count) in &entries {
        let [what, remedy] = ["what", "remedy"].map(|key| record[key].as_str().unwrap_or_default());
        let times = if *count > 1 { format!(" ({count} times)") } else { String::new() };
        text += &format!("  {what}{times}\n    to test it: {remedy}\n");
    }
    text
}

/// Removes the records of test runs that failed or were stopped before they printed their list.
fn remove_ended_runs(folder: &Path) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let run = name.trim_end_matches(".jsonl").split_once('-');
        let runs = run.and_then(|(process, start)| {
            Some(start_ticks(process.parse().ok()?)? == start.parse::<u64>().ok()?)
        });
        if runs != Some(true) {
            let _ = fs::remove_file(entry.path());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;
    use crate::skipped::append;

    #[test]
    fn records_of_writers_at_the_same_time_are_all_listed_once_with_their_count() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("new/run.jsonl");
        thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..25 {
                        append(&file, "the page in a browser", "apt install chromium");
                    }
                });
            }
        });
        append(&file, "a \"unit\"", "apt install systemd");
        let listed = "Skipped in this test run:\n  \
                      the page in a browser (200 times)\n    to test it: apt install chromium\n  \
                      a \"unit\"\n    to test it: apt install systemd\n";
        assert_eq!(text(&fs::read_to_string(&file).unwrap()), listed);
        assert_eq!(text(""), "Nothing was skipped in this test run.\n");
    }

    #[test]
    fn records_of_runs_that_have_ended_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: String| folder.path().join(name);
        let own = std::process::id();
        let start = start_ticks(own).unwrap();
        let running = path(format!("{own}-{start}.jsonl"));
        // A later process with the id of an earlier one.
        let ended = path(format!("{own}-{}.jsonl", start + 1));
        for file in [&running, &ended, &path("other".to_owned())] {
            append(file, "a test", "a command");
        }
        remove_ended_runs(folder.path());
        let left: Vec<_> =
            fs::read_dir(folder.path()).unwrap().map(|it| it.unwrap().path()).collect();
        assert_eq!(left, [running]);
    }
}
