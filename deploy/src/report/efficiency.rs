//! Sample efficiency: environment steps until a task counts as learnt, by task and method.

use serde::Serialize;

use super::collect::Results;
use super::measures::Measure;
use super::provenance::Makers;
use super::run::Run;
use super::statistics::{INTERVAL_SCORES_MIN, median_with_bounds, range};
use super::thresholds::{mark, threshold};
use crate::terminal::grouped;

/// One task's row.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EfficiencyRow {
    /// The task.
    pub task: String,
    /// `return ≥ -10`.
    pub threshold: String,
    /// Who says so.
    pub source: &'static str,
    /// In the order of the methods.
    pub cells: Vec<EfficiencyCell>,
}

/// When the seeds of one task and method were there.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct EfficiencyCell {
    /// Environment steps of each seed that is there or has ended; null for one that ended without.
    pub steps: Vec<Option<f64>>,
    /// Seeds that are under way and not there.
    pub unfinished: usize,
    /// Null where half of the seeds or more ended without.
    pub median: Option<f64>,
    /// Its 95 % interval by bootstrap from four seeds on. An end is null if it lies beyond every
    /// run; both are null below four seeds.
    pub interval: [Option<f64>; 2],
    /// Fewest and most steps; null for a seed that ended without.
    pub range: [Option<f64>; 2],
    /// What the paper says.
    pub paper: Option<&'static str>,
    /// Programs and packages behind the figure.
    #[serde(flatten)]
    pub makers: Makers,
}

impl EfficiencyCell {
    fn of<'r>(task: &str, method: &str, runs: impl Iterator<Item = &'r Run> + Clone) -> Self {
        let makers = Makers::of(runs.clone());
        let (mut steps, mut unfinished) = (Vec::new(), 0);
        for run in runs {
            match Measure::StepsToThreshold.of(run) {
                Some(of_run) => steps.push(of_run),
                None => unfinished += 1,
            }
        }
        let mut cell = Self {
            unfinished,
            paper: mark(task, method).map(|mark| mark.0),
            makers,
            ..Self::default()
        };
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

    /// The cell's lines, for people.
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
            let mark = self.makers.mark();
            lines.push(format!("{reached} of {} seeds{mark}", self.steps.len()));
            if self.unfinished > 0 {
                lines.push(format!("{} under way", self.unfinished));
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

/// A row for each task that has a threshold and a run.
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
    use super::super::planted::{Planted, planted};
    use super::*;

    #[test]
    fn a_seed_that_ended_without_counts_as_later_than_all_and_one_under_way_does_not_count() {
        let run = |seed, rows: Vec<f64>, ended| Planted {
            task: "reacher-v1",
            method: "DDPG",
            seed,
            rows,
            ended,
        };
        let results = planted(&[
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
                "1 under way",
                "paper: about 33,000"
            ]
        );
    }

    #[test]
    fn a_method_without_runs_is_not_run_and_one_that_never_came_there_says_so() {
        let never =
            Planted { task: "reacher-v1", method: "NDP", seed: 1, rows: vec![-15.0], ended: true };
        let mut results = planted(&[never]);
        results.methods.push("SAC".to_owned());
        let rows = efficiency(&results);
        assert_eq!(rows[0].cells[0].lines(), ["not reached", "0 of 1 seeds"]);
        assert_eq!(rows[0].cells[1].lines(), ["not run"]);
        let own =
            Planted { task: "point-reach", method: "TD3", seed: 1, rows: vec![-1.0], ended: true };
        assert!(efficiency(&planted(&[own])).is_empty(), "a user's own task has no threshold");
    }
}
