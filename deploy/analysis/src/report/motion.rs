//! Collects the motion of the runs: reads it if it has been measured, otherwise has the latest
//! policy rolled out.

use dmprl_run::RunDirectory;
use dmprl_run::failure::Outcome;

use super::motion_metrics::MotionMetrics;
use super::results::Results;
use super::run::{Run, Source};
use super::snapshot;
use crate::motion::{self, Motion};

/// Number of consecutive failures on a task after which its other runs are skipped.
const FAILURES_MAX: usize = 2;

/// Reads the motions measured before. Runs of an earlier report cannot be measured; those without a
/// motion are added to `results.unmeasured`.
///
/// # Errors
/// A run cannot be read.
pub(super) fn read_motions(results: &mut Results) -> anyhow::Result<()> {
    for run in results.runs.iter_mut().filter(|run| run.ended) {
        match &run.source {
            Source::Directory(path) => {
                let motion = motion::read(&RunDirectory::open(path)?)?;
                run.motion = motion.as_ref().map(MotionMetrics::of);
            }
            Source::Report(report) if run.motion.is_none() => {
                let file = snapshot::find(report).unwrap_or_else(|| report.clone());
                results.unmeasured.push(format!(
                    "{}: not measured in {}",
                    run.key(),
                    file.display()
                ));
            }
            Source::Report(_) => {}
        }
    }
    Ok(())
}

/// Returns the number of finished runs that can be measured but have not been.
#[must_use]
pub fn unmeasured(results: &Results) -> usize {
    results.runs.iter().filter(|run| is_unmeasured(run)).count()
}

fn is_unmeasured(run: &Run) -> bool {
    run.last().is_some() && run.motion.is_none() && run.directory().is_some()
}

/// A run to measure.
#[derive(Debug)]
pub struct UnmeasuredRun<'r> {
    /// Run directory.
    pub directory: &'r RunDirectory,
    /// Task, method and seed.
    pub name: &'r str,
    /// Index of the run among the unmeasured ones.
    pub index: u64,
}

/// Measures the motion of the runs that have none. If that fails for a run, appends the reason to
/// `results.unmeasured` and continues.
///
/// - `measure`: rolls out the run's latest policy; returns `None` if the user interrupts.
pub fn measure_motions(
    results: &mut Results,
    mut measure: impl FnMut(&UnmeasuredRun<'_>) -> anyhow::Result<Option<Motion>>,
) -> Outcome {
    let mut failures: Vec<(String, usize)> = Vec::new();
    let runs = results.runs.iter_mut().filter(|run| is_unmeasured(run));
    for (index, run) in (0..).zip(runs) {
        let Some(path) = run.directory() else { continue };
        let name = run.key().to_string();
        let failed = failures.iter().position(|(task, _)| *task == run.task);
        if failed.is_some_and(|at| failures[at].1 >= FAILURES_MAX) {
            results.unmeasured.push(format!("{name}: skipped after {FAILURES_MAX} failures"));
            continue;
        }
        let measured = RunDirectory::open(path).and_then(|directory| {
            measure(&UnmeasuredRun { directory: &directory, name: &name, index })
        });
        match measured {
            Ok(Some(motion)) => {
                run.motion = Some(MotionMetrics::of(&motion));
                failures.retain(|(task, _)| *task != run.task);
            }
            Ok(None) => return Outcome::Interrupted,
            Err(error) => {
                results.unmeasured.push(format!("{name}: {}", in_one_line(&error)));
                match failed {
                    Some(at) => failures[at].1 += 1,
                    None => failures.push((run.task.clone(), 1)),
                }
            }
        }
    }
    Outcome::Done
}

/// Formats an error in one line. Of an error that quotes the end of a log, it keeps the first line
/// and the last line of the log.
pub(super) fn in_one_line(error: &anyhow::Error) -> String {
    let text = format!("{error:#}");
    let mut lines = text.lines().map(str::trim);
    let first = lines.next().unwrap_or_default().to_owned();
    match lines.rfind(|line| !line.is_empty() && !line.starts_with("--- ")) {
        Some(last) => format!("{first}: {}", last.trim_start_matches("error: ")),
        None => first,
    }
}

#[cfg(test)]
mod tests {
    use anyhow::bail;
    use dmprl_shared::config::ExperimentConfig;

    use super::super::fixtures::{FixtureRun, fixture_results, motion_of};
    use super::*;
    use dmprl_run::Manifest;

    /// Returns finished runs of the tasks, each with an empty run directory.
    fn runs_in(parent: &tempfile::TempDir, tasks: &[&'static str]) -> Results {
        let run = |(seed, task): (u64, &&'static str)| FixtureRun {
            task,
            method: "TD3",
            seed,
            rows: vec![-1.0],
            ended: true,
        };
        let mut results = fixture_results(&(1..).zip(tasks).map(run).collect::<Vec<_>>());
        for run in &mut results.runs {
            let path = parent.path().join(run.seed.to_string());
            let manifest = Manifest::new(None).unwrap();
            RunDirectory::create(&path, &ExperimentConfig::default(), &manifest).unwrap();
            run.source = Source::Directory(path);
        }
        results
    }

    #[test]
    fn other_runs_of_a_task_are_skipped_after_two_failures() {
        let parent = tempfile::tempdir().unwrap();
        let mut results = runs_in(&parent, &["reacher", "reacher", "reacher", "pusher"]);
        assert_eq!(unmeasured(&results), 4);
        let mut tried = Vec::new();
        let outcome = measure_motions(&mut results, |run| {
            tried.push(run.index);
            if run.name.starts_with("reacher") {
                bail!("no OpenGL");
            }
            Ok(Some(motion_of(3.0, -2.0)))
        });
        assert_eq!(outcome, Outcome::Done);
        assert_eq!(tried, [0, 1, 3]);
        assert_eq!(results.unmeasured.len(), 3);
        assert!(results.unmeasured[0].ends_with("seed 1: no OpenGL"), "{:?}", results.unmeasured);
        assert_eq!(results.runs[3].motion.as_ref().unwrap().sparc, Some(-2.0));
    }

    #[test]
    fn interrupt_stops_the_measurements() {
        let parent = tempfile::tempdir().unwrap();
        let mut results = runs_in(&parent, &["reacher", "pusher"]);
        let mut calls = 0;
        let outcome = measure_motions(&mut results, |_| {
            calls += 1;
            Ok(None)
        });
        assert_eq!((outcome, calls, unmeasured(&results)), (Outcome::Interrupted, 1, 2));
    }

    #[test]
    fn error_with_a_log_is_shortened_to_its_cause() {
        let died = anyhow::anyhow!(
            "the observer died: exit status 1\n  last lines of a.log:\n    \
             error: no such folder\n    --- observer, later ---"
        );
        assert_eq!(in_one_line(&died), "the observer died: exit status 1: no such folder");
        assert_eq!(in_one_line(&anyhow::anyhow!("one line")), "one line");
    }
}
