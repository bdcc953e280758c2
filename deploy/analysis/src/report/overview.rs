//! Summarises the runs: how many are finished, when they started, on which machines, and missing
//! measurements and pictures.

use dmprl_run::format::grouped;

use super::families::distinct;
use super::layout::Grid;
use super::results::Results;
use super::run::Run;

/// Returns a paragraph: how many runs are finished, when they started and on which machines.
#[must_use]
pub fn summary(results: &Results) -> String {
    let ended = results.runs.iter().filter(|run| run.ended).count();
    let unfinished = results.runs.len() - ended;
    let not_started = results.not_started.len();
    let planned = results.runs.len() + not_started;
    let mut runs = format!("{ended} of {planned} runs are finished");
    for (count, what) in [(unfinished, "unfinished"), (not_started, "not started")] {
        if count > 0 {
            runs.push_str(&format!(", {count} {what}"));
        }
    }
    runs.push('.');
    let mut started: Vec<&str> =
        results.runs.iter().map(|run| run.origin.started.as_str()).collect();
    started.sort_unstable();
    if let (Some(first), Some(last)) = (started.first(), started.last()) {
        let span = if first == last {
            format!("at {first}")
        } else {
            format!("between {first} and {last}")
        };
        runs.push_str(&format!(" Started {span}."));
    }
    let machines = distinct(results.runs.iter().map(|run| run.origin.machine.as_str()));
    format!("{runs} Trained on {}.", machines.join("; "))
}

/// Returns sentences about motions that were not measured and pictures that were not drawn.
#[must_use]
pub fn omissions(results: &Results) -> Vec<String> {
    let mut sentences = Vec::new();
    if let Some(first) = results.unmeasured.first() {
        let count = match results.unmeasured.len() {
            1 => "1 run".to_owned(),
            count => format!("{count} runs"),
        };
        sentences.push(format!("The motion of {count} was not measured. First reason: {first}."));
    }
    if !results.undrawn.is_empty() {
        sentences.push(format!("Not drawn: {}.", results.undrawn.join("; ")));
    }
    sentences
}

/// Returns a table of seeds and steps by task and method.
#[must_use]
pub fn runs_table(results: &Results) -> Grid {
    let cell = |task: &str, method: &str| {
        let mut runs: Vec<&Run> = results.of(task, method).collect();
        runs.sort_by_key(|run| run.seed);
        let seeds_of = |ended: bool| {
            let seeds = runs.iter().filter(|run| run.ended == ended);
            let seeds: Vec<_> = seeds.map(|run| run.seed.to_string()).collect();
            format!("{} {}", if seeds.len() == 1 { "seed" } else { "seeds" }, seeds.join(", "))
        };
        let mut lines = Vec::new();
        if runs.is_empty() {
            lines.push("not run".to_owned());
        }
        if runs.iter().any(|run| run.ended) {
            lines.push(seeds_of(true));
        }
        if runs.iter().any(|run| !run.ended) {
            lines.push(format!("unfinished: {}", seeds_of(false)));
        }
        let mut steps: Vec<u64> = runs.iter().map(|run| run.steps).collect();
        steps.sort_unstable();
        steps.dedup();
        let steps: Vec<_> = steps.into_iter().map(grouped).collect();
        if !steps.is_empty() {
            lines.push(format!("{} steps each", steps.join(" or ")));
        }
        lines
    };
    Grid::of(results, cell)
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_results};
    use super::*;

    #[test]
    fn finished_unfinished_and_not_started_runs_are_counted_separately() {
        let run = |seed, ended| FixtureRun {
            task: "reacher-v1",
            method: "DDPG",
            seed,
            rows: vec![-9.0, -8.0],
            ended,
        };
        let mut results = fixture_results(&[run(2, true), run(1, true), run(3, false)]);
        results.not_started = vec![results.runs[0].key(); 7];
        for (run, machine) in results.runs.iter_mut().zip(["a", "b", "a"]) {
            run.origin.machine = machine.to_owned();
        }
        let summary = summary(&results);
        let runs = "2 of 10 runs are finished, 1 unfinished, 7 not started. Started ";
        assert!(summary.starts_with(runs) && summary.ends_with(" Trained on a; b."), "{summary}");
        let grid = runs_table(&results);
        assert_eq!(
            grid.rows[0].cells[0].lines,
            ["seeds 1, 2", "unfinished: seed 3", "2,000 steps each"]
        );
    }
}
