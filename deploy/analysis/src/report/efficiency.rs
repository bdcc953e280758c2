//! Computes the sample efficiency: environment steps until a threshold is reached, by task and
//! method.

use dmprl_run::format::grouped;
use serde::Serialize;

use super::measures::Measure;
use super::provenance::SoftwareCounts;
use super::results::Results;
use super::run::Run;
use super::statistics::{INTERVAL_SCORES_MIN, median_with_bounds, range};
use super::thresholds::{reported_steps, threshold};

/// Sample efficiency of all methods on a task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EfficiencyRow {
    /// The task.
    pub task: String,
    /// The threshold, such as `return ≥ -10`.
    pub threshold: String,
    /// Source of the threshold.
    pub source: &'static str,
    /// Cells in the order of the methods.
    pub cells: Vec<EfficiencyCell>,
}

/// Environment steps until the seeds of a method reached the threshold.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct EfficiencyCell {
    /// Environment steps of each seed; null for a finished seed that never reached the threshold.
    /// Unfinished seeds that have not reached it are left out.
    pub steps: Vec<Option<f64>>,
    /// Number of unfinished seeds that have not reached the threshold.
    pub unfinished: usize,
    /// Median; null if at least half of the seeds never reached the threshold.
    pub median: Option<f64>,
    /// Bounds of the median's 95 % bootstrap interval. A bound is null if it is infinite; both are
    /// null with fewer than four seeds.
    pub interval: [Option<f64>; 2],
    /// Minimum and maximum; null if that seed never reached the threshold.
    pub range: [Option<f64>; 2],
    /// The steps that the paper reports, in its words.
    pub paper: Option<&'static str>,
    /// Number of programs and sets of packages.
    #[serde(flatten)]
    pub software: SoftwareCounts,
}

impl EfficiencyCell {
    fn of<'r>(task: &str, method: &str, runs: impl Iterator<Item = &'r Run> + Clone) -> Self {
        let software = SoftwareCounts::of(runs.clone());
        let (mut steps, mut unfinished) = (Vec::new(), 0);
        for run in runs {
            match Measure::StepsToThreshold.of(run) {
                Some(of_run) => steps.push(of_run),
                None => unfinished += 1,
            }
        }
        let mut cell =
            Self { unfinished, paper: reported_steps(task, method), software, ..Self::default() };
        if !steps.is_empty() {
            let (median, bounds) = median_with_bounds(&steps);
            cell.median = finite(median);
            if steps.len() >= INTERVAL_SCORES_MIN {
                cell.interval = bounds.map(finite);
            }
            cell.range = range(&steps).map(finite);
        }
        cell.steps = steps.into_iter().map(finite).collect();
        cell
    }

    /// Returns the cell's lines of text.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let mut lines = Vec::new();
        if self.steps.is_empty() {
            let state = if self.unfinished > 0 { "not finished" } else { "not run" };
            lines.push(state.to_owned());
        } else {
            let reached = self.steps.iter().flatten().count();
            lines.push(number(self.median));
            if reached > 0 && self.steps.len() > 1 {
                let is_range = self.steps.len() < INTERVAL_SCORES_MIN;
                let [low, high] = if is_range { self.range } else { self.interval }.map(number);
                let name = if is_range { "range " } else { "" };
                lines.push(format!("{name}[{low} – {high}]"));
            }
            let mark = self.software.mark();
            lines.push(format!("{reached} of {} seeds{mark}", self.steps.len()));
            if self.unfinished > 0 {
                lines.push(format!("{} unfinished", self.unfinished));
            }
        }
        lines.extend(self.paper.map(|paper| format!("paper: {paper}")));
        lines
    }
}

fn finite(steps: f64) -> Option<f64> {
    steps.is_finite().then_some(steps)
}

fn number(steps: Option<f64>) -> String {
    steps.map_or_else(|| "not reached".to_owned(), |steps| grouped(steps.round() as u64))
}

/// Returns a row for each task that has a threshold and a run.
#[must_use]
pub fn efficiency(results: &Results) -> Vec<EfficiencyRow> {
    let row = |task: &String| {
        let threshold = threshold(task)?;
        let cells: Vec<_> = results
            .methods
            .iter()
            .map(|method| EfficiencyCell::of(task, method, results.of(task, method)))
            .collect();
        if cells.iter().all(|cell| cell.steps.is_empty()) {
            return None;
        }
        let (text, source) = (threshold.text(), threshold.source);
        Some(EfficiencyRow { task: task.clone(), threshold: text, source, cells })
    };
    results.tasks.iter().filter_map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_results};
    use super::*;

    #[test]
    fn seed_that_never_reached_the_threshold_is_infinite_and_an_unfinished_one_left_out() {
        let run = |seed, rows: Vec<f64>, ended| FixtureRun {
            task: "reacher-v1",
            method: "DDPG",
            seed,
            rows,
            ended,
        };
        let results = fixture_results(&[
            run(1, vec![-12.0, -9.5, -11.0], true),
            run(2, vec![-12.0, -11.0, -10.0], true),
            run(3, vec![-12.0, -11.0, -10.1], true),
            run(4, vec![-12.0], false),
        ]);
        let rows = efficiency(&results);
        assert_eq!((rows.len(), rows[0].source), (1, "the paper's section 4.2"));
        let cell = &rows[0].cells[0];
        assert_eq!(cell.steps, [Some(2_000.0), Some(3_000.0), None]);
        assert_eq!((cell.median, cell.interval), (Some(3_000.0), [None, None]));
        assert_eq!(cell.range, [Some(2_000.0), None]);
        assert_eq!(
            cell.lines(),
            [
                "3,000",
                "range [2,000 – not reached]",
                "2 of 3 seeds",
                "1 unfinished",
                "paper: about 33,000"
            ]
        );
    }

    #[test]
    fn method_without_runs_differs_from_one_that_never_reached_the_threshold() {
        let never = FixtureRun {
            task: "reacher-v1",
            method: "NDP",
            seed: 1,
            rows: vec![-15.0],
            ended: true,
        };
        let mut results = fixture_results(&[never]);
        results.methods.push("SAC".to_owned());
        let rows = efficiency(&results);
        assert_eq!(rows[0].cells[0].lines(), ["not reached", "0 of 1 seeds"]);
        assert_eq!(rows[0].cells[1].lines(), ["not run"]);
        let own = FixtureRun {
            task: "point-reach",
            method: "TD3",
            seed: 1,
            rows: vec![-1.0],
            ended: true,
        };
        assert!(
            efficiency(&fixture_results(&[own])).is_empty(),
            "a user's own task has no threshold"
        );
    }
}
