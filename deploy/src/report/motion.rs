//! How the runs move: what is known already is read, what is not is measured, by rolling each run's
//! last policy out.

use super::collect::Results;
use super::landed;
use super::moves::Moves;
use super::run::{Run, Source};
use crate::failure::Outcome;
use crate::motion::{self, Means};
use crate::run_directory::RunDirectory;
use crate::terminal::CountProgress;

/// Where that many runs of a task in a row cannot be measured, the others cannot either.
const FAILURES_MAX: usize = 2;

/// Reads what was measured before. A landed run brings it along, or nobody can measure it any more.
///
/// # Errors
/// A run cannot be read.
pub(super) fn read_motions(results: &mut Results) -> anyhow::Result<()> {
    for run in results.runs.iter_mut().filter(|run| run.ended) {
        match &run.source {
            Source::Directory(path) => {
                let motion = motion::read(&RunDirectory::open(path)?)?;
                run.motion = motion.as_ref().map(Moves::of);
            }
            Source::Report(report) if run.motion.is_none() => {
                let file = report.join(landed::FILE);
                results.unmeasured.push(format!("{}: {} has none", run.key(), file.display()));
            }
            Source::Report(_) => {}
        }
    }
    Ok(())
}

/// Runs at their end that can be measured and are not.
#[must_use]
pub fn unmeasured(results: &Results) -> usize {
    results.runs.iter().filter(|run| is_unmeasured(run)).count()
}

fn is_unmeasured(run: &Run) -> bool {
    run.last().is_some() && run.motion.is_none() && run.directory().is_some()
}

/// Measures them; keeps the result in each run, so that it is done once. A run that cannot be
/// measured is left out, with the reason in `results.unmeasured`.
pub fn measure_motions(results: &mut Results, means: &Means) -> Outcome {
    let progress = CountProgress::new("measuring motion", unmeasured(results) as u64);
    let mut failures: Vec<(String, usize)> = Vec::new();
    let runs = results.runs.iter_mut().filter(|run| is_unmeasured(run));
    for (done, run) in (0..).zip(runs) {
        let Some(path) = run.directory() else { continue };
        let name = run.key().to_string();
        progress.at(done, &name);
        let failed = failures.iter().position(|(task, _)| *task == run.task);
        if failed.is_some_and(|index| failures[index].1 >= FAILURES_MAX) {
            results.unmeasured.push(format!("{name}: not tried after those before it"));
            continue;
        }
        let measured = RunDirectory::open(path)
            .and_then(|directory| motion::measure(&directory, means, &|_, _| ()));
        match measured {
            Ok(Some(motion)) => {
                run.motion = Some(Moves::of(&motion));
                failures.retain(|(task, _)| *task != run.task);
            }
            Ok(None) => return Outcome::Interrupted,
            Err(error) => {
                results.unmeasured.push(format!("{name}: {}", in_a_line(&error)));
                match failed {
                    Some(index) => failures[index].1 += 1,
                    None => failures.push((run.task.clone(), 1)),
                }
            }
        }
    }
    Outcome::Done
}

/// An error that quotes the end of a log, as its first line and the last of the log.
pub(super) fn in_a_line(error: &anyhow::Error) -> String {
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
    use super::*;

    #[test]
    fn of_an_error_with_a_log_the_cause_is_told() {
        let died = anyhow::anyhow!(
            "the observer died: exit status 1\n  last lines of a.log:\n    \
             error: no such folder\n    --- observer, later ---"
        );
        assert_eq!(in_a_line(&died), "the observer died: exit status 1: no such folder");
        assert_eq!(in_a_line(&anyhow::anyhow!("one line")), "one line");
    }
}
