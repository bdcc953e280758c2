//! Provenance of the figures: the programs and packages that made the runs of each cell, and the
//! data available for them.

use std::collections::BTreeSet;

use serde::Serialize;

use super::families::distinct;
use super::layout::Grid;
use super::results::Results;
use super::run::{Origin, Run};

/// Number of different programs and sets of package versions behind a figure.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct SoftwareCounts {
    /// Programs, by version and commit. A run whose sources are unknown counts as a separate
    /// program.
    pub programs: usize,
    /// Sets of package versions, counted in the same way.
    pub package_sets: usize,
}

impl SoftwareCounts {
    /// Counts over all sessions of the runs.
    pub fn of<'r>(runs: impl Iterator<Item = &'r Run>) -> Self {
        let runs: Vec<&Run> = runs.collect();
        let count = |known: fn(&Origin) -> Option<&[String]>| {
            let of_runs = || runs.iter().map(|run| known(&run.origin));
            let distinct: BTreeSet<&String> = of_runs().flatten().flatten().collect();
            distinct.len() + of_runs().filter(Option::is_none).count()
        };
        Self {
            programs: count(Origin::known_programs),
            package_sets: count(Origin::known_packages),
        }
    }

    /// Returns the mark after a figure of several programs or sets of packages; otherwise nothing.
    #[must_use]
    pub fn mark(self) -> &'static str {
        if self.programs > 1 || self.package_sets > 1 { " †" } else { "" }
    }
}

/// Programs and package versions of a report's runs, numbered for its cells.
#[derive(Debug, Clone)]
pub struct Provenance {
    /// Each program with its packages.
    sources: Vec<String>,
    /// Programs and available data of the runs in each cell.
    pub grid: Grid,
}

/// Describes the programs and packages of a run.
fn source(run: &Run) -> String {
    let joined = |texts: &[String]| {
        let texts = distinct(texts.iter().map(String::as_str));
        texts.join("; then ")
    };
    let programs = joined(&run.origin.programs);
    let packages = if run.origin.packages.is_empty() {
        "package versions not recorded".to_owned()
    } else {
        joined(&run.origin.packages)
    };
    format!("dmprl {programs}; {packages}")
}

impl Provenance {
    /// Collects the provenance of all runs that have started.
    #[must_use]
    pub fn of(results: &Results) -> Self {
        let mut sources: Vec<String> = Vec::new();
        for run in &results.runs {
            let source = source(run);
            if !sources.contains(&source) {
                sources.push(source);
            }
        }
        let grid = Grid::of(results, |task, method| cell(results, task, method, &sources));
        Self { sources, grid }
    }

    /// Returns a paragraph that lists the numbered programs.
    #[must_use]
    pub fn legend(&self) -> String {
        let numbered =
            self.sources.iter().zip(1..).map(|(text, number)| format!("[{number}] {text}"));
        format!("{}.", numbered.collect::<Vec<_>>().join(". "))
    }
}

/// Formats a cell: the seeds of each program, such as `[1]: seeds 1, 2`, then the seeds with a
/// motion and with a rollout.
fn cell(results: &Results, task: &str, method: &str, sources: &[String]) -> Vec<String> {
    let mut runs: Vec<&Run> = results.of(task, method).collect();
    runs.sort_by_key(|run| run.seed);
    let seeds = |filter: &dyn Fn(&Run) -> bool| -> Option<String> {
        let seeds: Vec<String> =
            runs.iter().filter(|run| filter(run)).map(|run| run.seed.to_string()).collect();
        let word = if seeds.len() == 1 { "seed" } else { "seeds" };
        (!seeds.is_empty()).then(|| format!("{word} {}", seeds.join(", ")))
    };
    let mut lines = Vec::new();
    for (text, number) in sources.iter().zip(1..) {
        lines
            .extend(seeds(&|run| source(run) == *text).map(|seeds| format!("[{number}]: {seeds}")));
    }
    let has_motion = |run: &Run| run.motion.is_some();
    let has_rollout =
        |run: &Run| run.motion.as_ref().is_some_and(|motion| motion.rollout.is_some());
    lines.extend(seeds(&has_motion).map(|seeds| format!("motion: {seeds}")));
    lines.extend(seeds(&has_rollout).map(|seeds| format!("rollout: {seeds}")));
    if lines.is_empty() {
        lines.push("not run".to_owned());
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_motion, fixture_results};
    use super::*;

    #[test]
    fn cells_list_programs_and_available_data_by_seed() {
        let run = |method, seed| FixtureRun {
            task: "pusher-v0",
            method,
            seed,
            rows: vec![-40.0],
            ended: true,
        };
        let mut results =
            fixture_results(&[run("SAC", 2), run("SAC", 1), run("SAC", 3), run("TD3", 1)]);
        for run in &mut results.runs {
            run.origin.packages.clear();
            run.origin.programs = vec!["0.1.0 (commit 1)".to_owned(); 2];
        }
        results.runs[2].origin.programs.push("0.1.0 (commit 2)".to_owned());
        results.runs[3].origin.packages = vec!["Python 3.11.7".to_owned()];
        results.runs[0].motion = Some(fixture_motion(1.0, -1.0));
        results.tasks.push("thrower-v0".to_owned());
        let provenance = Provenance::of(&results);
        assert_eq!(
            provenance.legend(),
            "[1] dmprl 0.1.0 (commit 1); package versions not recorded. \
             [2] dmprl 0.1.0 (commit 1); then 0.1.0 (commit 2); package versions not recorded. \
             [3] dmprl 0.1.0 (commit 1); Python 3.11.7."
        );
        let cells = &provenance.grid.rows[0].cells;
        let expected = ["[1]: seeds 1, 2", "[2]: seed 3", "motion: seed 2", "rollout: seed 2"];
        assert_eq!(cells[0].lines, expected);
        assert_eq!(cells[1].lines, ["[3]: seed 1"]);
        assert_eq!(provenance.grid.rows[1].cells[0].lines, ["not run"]);
    }
}
