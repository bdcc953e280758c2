//! Checks a stopped run: its last checkpoint, its metrics, and that it has cleaned up.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_learner::checkpoint;
use dmprl_learner::learner::Learner;
use dmprl_learner::metrics::MetricsLine;
use dmprl_run::Setup;
use dmprl_supervisor::members::of_session;
use rustix::process::Pid;

use super::checker::{Checker, SegmentTotals};
use super::samples::shared_memory;
use super::violations::Violations;
use crate::journal::LearnerCounters;

/// Time limit for all processes of a finished run to exit.
const EXIT_TIMEOUT: Duration = Duration::from_secs(10);
/// Interval between checks.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// Compares the files on disk with the journals (I1, I5, I9).
pub(super) fn check_files(run: &Path, checker: &Checker, sums: &SegmentTotals) -> Violations {
    let mut violations = Violations::default();
    let checked = check_checkpoint(run, checker, &mut violations)
        .and_then(|()| check_metrics(run, checker.counters(), sums, &mut violations));
    if let Err(error) = checked {
        violations.add(format!("I5: {error:#}"));
    }
    violations
}

fn check_checkpoint(
    run: &Path,
    checker: &Checker,
    violations: &mut Violations,
) -> anyhow::Result<()> {
    let setup = Setup::read(run)?;
    let spec = setup.run.spec()?.context("the run has no spec.json")?;
    let fresh = || Learner::new(setup.config.clone(), &spec, setup.run_id);
    let (learner, loaded) = checkpoint::load_newest(&setup.run.checkpoints_path(), &fresh)?;
    violations
        .extend(loaded.rejected.iter().map(|why| format!("I5: a checkpoint was rejected: {why}")));
    let (found, expected) = (LearnerCounters::from(&learner.counters), checker.counters());
    // Not compared: the number of updates, because the journal has only segments.
    if (found.env_steps, found.segments) != (expected.env_steps, expected.segments) {
        violations.add(format!(
            "I5: the last checkpoint has {found:?}, the last learner reached {expected:?}"
        ));
    }
    let (found, expected) = (learner.inbox.settled(), checker.settled());
    if found != expected {
        violations
            .add(format!("I1: the last checkpoint has {found:?}, inserted were {expected:?}"));
    }
    Ok(())
}

fn check_metrics(
    run: &Path,
    counters: LearnerCounters,
    sums: &SegmentTotals,
    violations: &mut Violations,
) -> anyhow::Result<()> {
    let path = run.join("metrics.jsonl");
    let text = std::fs::read_to_string(&path);
    let text = text.with_context(|| format!("cannot read {}", path.display()))?;
    let mut last: Option<MetricsLine> = None;
    for (number, line) in text.lines().enumerate() {
        let line: MetricsLine = serde_json::from_str(line)
            .with_context(|| format!("{} line {}", path.display(), number + 1))?;
        if let Some(last) = last.as_ref().filter(|last| {
            line.env_steps <= last.env_steps
                || line.updates < last.updates
                || line.policy_version < last.policy_version
        }) {
            violations.add(format!(
                "I5: metrics.jsonl goes from {} steps, {} updates, policy {} to {}, {}, {}",
                last.env_steps,
                last.updates,
                last.policy_version,
                line.env_steps,
                line.updates,
                line.policy_version
            ));
        }
        last = Some(line);
    }
    let last = last.context("metrics.jsonl is empty")?;
    if (last.env_steps, last.segments) != (counters.env_steps, counters.segments) {
        violations.add(format!(
            "I5: metrics.jsonl ends at {} steps and {} segments, the last learner at {counters:?}",
            last.env_steps, last.segments
        ));
    }
    if last.lost > 0 {
        violations.add(format!("I1: metrics.jsonl counts {} lost segments", last.lost));
    }
    if last.rejected.total() > sums.rejected {
        violations.add(format!(
            "I9: metrics.jsonl counts {} rejected segments, the journals {}",
            last.rejected.total(),
            sums.rejected
        ));
    }
    // May be lower: workers report once per second, so a killed worker's last counts are missing.
    let delivery = last.delivery;
    if delivery.produced > sums.produced || delivery.acked > sums.acknowledged {
        violations.add(format!("I9: metrics.jsonl counts more than the journals: {delivery:?}"));
    }
    Ok(())
}

/// Checks for leftovers of the run (I8): processes, shared memory, temporary files.
pub(super) fn check_leftovers(
    run: &Path,
    run_id: &str,
    session: Pid,
) -> anyhow::Result<Violations> {
    let mut violations = Violations::default();
    let deadline = Instant::now() + EXIT_TIMEOUT;
    let processes = loop {
        let processes = of_session(session)?;
        if processes.is_empty() || Instant::now() >= deadline {
            break processes;
        }
        std::thread::sleep(POLL_INTERVAL);
    };
    if !processes.is_empty() {
        violations.add(format!("I8: processes are still running: {}", processes.join(", ")));
    }
    for path in shared_memory(run_id) {
        violations.add(format!("I8: shared memory was not removed: {}", path.display()));
    }
    for path in temporary_files(run) {
        violations.add(format!("I8: a temporary file was not removed: {}", path.display()));
    }
    Ok(violations)
}

/// Lists the files and folders below a folder that still have their temporary names.
fn temporary_files(folder: &Path) -> Vec<PathBuf> {
    let entries = folder.read_dir().into_iter().flatten().flatten();
    let mut found = Vec::new();
    for path in entries.map(|entry| entry.path()) {
        let extension = path.extension().unwrap_or_default().to_string_lossy().into_owned();
        if extension.strip_prefix("tmp").is_some_and(|id| id.bytes().all(|b| b.is_ascii_digit())) {
            found.push(path);
        } else if path.is_dir() && !path.is_symlink() {
            found.extend(temporary_files(&path));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use dmprl_shared::config::ExperimentConfig;
    use dmprl_shared::spec::EnvSpec;
    use dmprl_supervisor::WholeRun;
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn temporary_files_are_found_in_all_folders() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path();
        std::fs::create_dir_all(run.join("checkpoints/.000012.tmp")).unwrap();
        std::fs::create_dir_all(run.join("checkpoints/000011")).unwrap();
        for name in ["segments.log", "checkpoints/000011/state.json", "config.toml"] {
            std::fs::write(run.join(name), "").unwrap();
        }
        for name in ["segments.tmp", "config.tmp123", "checkpoints/000011/networks.tmp"] {
            std::fs::write(run.join(name), "").unwrap();
        }
        assert_eq!(temporary_files(run).len(), 4);
        // No session has this id, because process ids are smaller.
        let no_session = Pid::from_raw(i32::MAX).unwrap();
        let violations = check_leftovers(run, "no such run", no_session).unwrap();
        assert_eq!(violations.count(), 4);
    }

    #[test]
    fn running_processes_of_the_session_are_found() {
        let folder = tempfile::tempdir().unwrap();
        let mut command = Command::new("sleep");
        command.arg("1000");
        // In its own session. The session of this test can be outside its process namespace.
        let child = WholeRun::start(command, &folder.path().join("log")).unwrap();
        let session = child.pid().unwrap();
        let expected = [session.as_raw_nonzero().to_string()];
        assert_eq!(of_session(session).unwrap(), expected);
        drop(child);
        assert!(of_session(session).unwrap().is_empty());
    }

    fn metrics(rows: &[Value]) -> Vec<String> {
        let folder = tempfile::tempdir().unwrap();
        let lines: Vec<String> = rows.iter().map(Value::to_string).collect();
        std::fs::write(folder.path().join("metrics.jsonl"), lines.join("\n")).unwrap();
        let mut violations = Violations::default();
        let sums = SegmentTotals {
            produced: 25,
            acknowledged: 20,
            inserted: 20,
            ..SegmentTotals::default()
        };
        let counters = LearnerCounters { env_steps: 100, updates: 0, segments: 20 };
        check_metrics(folder.path(), counters, &sums, &mut violations).unwrap();
        violations.into_sentences()
    }

    /// Returns a line of metrics as the learner writes it.
    fn line(env_steps: u64, updates: u64) -> Value {
        let mut config = ExperimentConfig::default();
        config.actors.workers = 1;
        let spec = EnvSpec::new("Fake-v0", 2, &[(-1.0, 1.0)], 0.02, 50);
        config.replay.capacity_steps = 1_000;
        let mut learner = Learner::new(config, &spec, 1).unwrap();
        learner.counters.env_steps = env_steps;
        learner.counters.updates = updates;
        learner.counters.segments = env_steps / 5;
        json!(learner.metrics_line())
    }

    #[test]
    fn i5_decreasing_metrics_are_found() {
        assert_eq!(metrics(&[line(50, 4), line(100, 9)]), Vec::<String>::new());
        let found = metrics(&[line(50, 10), line(100, 9)]);
        assert!(found.len() == 1 && found[0].starts_with("I5: metrics.jsonl goes"), "{found:?}");
        let found = metrics(&[line(50, 4)]);
        assert!(found.len() == 1 && found[0].starts_with("I5: metrics.jsonl ends"), "{found:?}");
    }

    #[test]
    fn i1_and_i9_metrics_that_contradict_the_journals_are_found() {
        let mut wrong = line(100, 9);
        wrong["lost"] = 2.into();
        assert!(metrics(&[wrong])[0].starts_with("I1: metrics.jsonl counts 2 lost"));
        let mut wrong = line(100, 9);
        wrong["delivery"]["acked"] = 21.into();
        assert!(metrics(&[wrong])[0].starts_with("I9: metrics.jsonl counts more"));
    }
}
