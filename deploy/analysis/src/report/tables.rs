//! Builds the tables of a report: one per measure, by task and method.

use dmprl_run::format::grouped;
use serde::Serialize;

use super::measures::{Measure, MeasureKind};
use super::paper::reported;
use super::provenance::SoftwareCounts;
use super::results::Results;
use super::statistics::Summary;

/// The table of a measure, with a cell for each task and method.
#[derive(Debug, Clone, Serialize)]
pub struct Table {
    /// Heading.
    pub title: &'static str,
    /// Description of the measure.
    pub about: &'static str,
    /// Number of decimals.
    pub digits: usize,
    /// Group of the measure, which determines the table's position in the report.
    #[serde(skip)]
    pub kind: MeasureKind,
    /// Rows: a task and its cells in the order of the methods.
    pub rows: Vec<(String, Vec<Cell>)>,
}

/// The values of one task and method.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Cell {
    /// Summary over the seeds with a value; `None` if there are none.
    pub summary: Option<Summary>,
    /// Number of unfinished seeds.
    pub unfinished: usize,
    /// Number of finished seeds whose value is unknown.
    pub unknown: usize,
    /// Mean and standard deviation that the paper reports.
    pub paper: Option<(f64, f64)>,
    /// Number of programs and sets of packages.
    #[serde(flatten)]
    pub software: SoftwareCounts,
}

impl Cell {
    /// Returns the cell's lines of text.
    #[must_use]
    pub fn lines(&self, digits: usize) -> Vec<String> {
        let mut lines = Vec::new();
        match &self.summary {
            None if self.unknown > 0 => lines.push("not measured".to_owned()),
            None if self.unfinished > 0 => lines.push("not finished".to_owned()),
            None => lines.push("not run".to_owned()),
            // With one seed, the standard deviation is unknown, not zero.
            Some(Summary { count: 1, mean, .. }) => {
                lines.extend([number(*mean, digits), format!("1 seed{}", self.software.mark())]);
            }
            Some(summary) => {
                let Summary { count, mean, std, .. } = *summary;
                let (point, bounds) = summary.point_and_bounds();
                let [mean, std, point, low, high] =
                    [mean, std, point, bounds[0], bounds[1]].map(|value| number(value, digits));
                lines.push(format!("{mean} ± {std}"));
                lines.push(match summary.interval {
                    Some(_) => format!("IQM {point} [{low}, {high}]"),
                    None => format!("range [{low}, {high}]"),
                });
                lines.push(format!("{count} seeds{}", self.software.mark()));
            }
        }
        if self.summary.is_some() && self.unknown > 0 {
            lines.push(format!("{} not measured", self.unknown));
        }
        if let Some((mean, std)) = self.paper {
            lines.push(format!("paper {mean:.digits$} ± {std:.digits$}"));
        }
        lines
    }
}

/// Formats a number; without decimals, with thousands separators.
fn number(value: f64, digits: usize) -> String {
    if digits == 0 && value >= 0.0 {
        grouped(value.round() as u64)
    } else {
        format!("{value:.digits$}")
    }
}

/// Returns the tables of the measures for which any value is known.
#[must_use]
pub fn tables(results: &Results) -> Vec<Table> {
    let shows = |table: &Table| {
        table.rows.iter().any(|(_, cells)| cells.iter().any(|cell| cell.summary.is_some()))
    };
    Measure::TABLES.into_iter().map(|measure| table(results, measure)).filter(shows).collect()
}

fn table(results: &Results, measure: Measure) -> Table {
    let cell = |task: &str, method: &str| {
        let runs = || results.of(task, method);
        let scores: Vec<f64> = runs().filter_map(|run| measure.of(run)).collect();
        Cell {
            software: SoftwareCounts::of(runs().filter(|run| measure.of(run).is_some())),
            summary: Summary::of(&scores),
            unfinished: runs().filter(|run| run.last().is_none()).count(),
            unknown: runs().filter(|run| run.last().is_some() && measure.of(run).is_none()).count(),
            paper: measure.in_paper().and_then(|table| reported(table, task, method)),
        }
    };
    let rows = results.tasks.iter().map(|task| {
        let cells = results.methods.iter().map(|method| cell(task, method));
        (task.clone(), cells.collect::<Vec<_>>())
    });
    // Omits tasks that do not have the measure, such as the success rate.
    let has_measure = |(_, cells): &(String, Vec<Cell>)| {
        cells.iter().any(|cell| cell.summary.is_some())
            || cells.iter().all(|cell| cell.unknown == 0)
    };
    Table {
        title: measure.title(),
        about: measure.about(),
        digits: measure.digits(),
        kind: measure.kind(),
        rows: rows.filter(has_measure).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_results};
    use super::*;

    #[test]
    fn cell_shows_the_range_below_four_seeds_and_marks_several_programs() {
        let run = |seed| FixtureRun {
            task: "point-reach",
            method: "TD3",
            seed,
            rows: vec![-(seed as f64)],
            ended: true,
        };
        let runs: Vec<_> = (1..=4).map(run).collect();
        let lines = |results: &Results| tables(results)[0].rows[0].1[0].lines(1);
        let mut three = fixture_results(&runs[..3]);
        assert_eq!(lines(&three), ["-2.0 ± 1.0", "range [-3.0, -1.0]", "3 seeds"]);
        three.runs[0].origin.programs = vec!["0.1.0 (commit 1234)".to_owned()];
        assert_eq!(lines(&three)[2], "3 seeds †");
        three.runs.iter_mut().for_each(|run| run.origin.programs = vec!["0.1.0".to_owned()]);
        assert_eq!(lines(&three)[2], "3 seeds †", "the commits are unknown");
        let known = || "0.1.0 (commit 1234)".to_owned();
        three.runs.iter_mut().for_each(|run| run.origin.programs = vec![known()]);
        three.runs[0].origin.programs = vec![known(), known()];
        three.runs[0].origin.packages.push("Python 3.11.7".to_owned());
        assert_eq!(lines(&three)[2], "3 seeds", "a run was resumed by the same program");
        let mut one = fixture_results(&runs[..1]);
        assert_eq!(lines(&one), ["-1.0", "1 seed"]);
        one.runs[0].origin.programs = vec![known(), "0.1.0 (commit 5678)".to_owned()];
        one.runs[0].origin.packages.push("Python 3.11.7".to_owned());
        assert_eq!(lines(&one), ["-1.0", "1 seed †"]);
        let four = fixture_results(&runs);
        assert!(lines(&four)[1].starts_with("IQM -2.5 ["), "{:?}", lines(&four));
        let mut packages = four;
        packages.runs[3].origin.packages = vec!["Python 3.12.1".to_owned()];
        assert_eq!(lines(&packages)[2], "4 seeds †");
    }

    #[test]
    fn task_without_success_rate_has_no_row_in_its_table() {
        let run =
            |task, method, ended| FixtureRun { task, method, seed: 1, rows: vec![0.5], ended };
        let results = fixture_results(&[
            run("reacher-v1", "TD3", true),
            run("panda-reach", "TD3", true),
            run("panda-reach", "SAC", false),
            run("panda-reach-joints", "SAC", false),
        ]);
        let tables = tables(&results);
        let table = |title: &str| tables.iter().find(|table| table.title == title).unwrap();
        let rows = |title: &str| {
            let rows = table(title).rows.iter().map(|(task, cells)| {
                let first = cells.iter().map(|cell| cell.lines(2).swap_remove(0));
                (task.as_str(), first.collect::<Vec<_>>())
            });
            rows.collect::<Vec<_>>()
        };
        let success = rows("Success rate");
        assert_eq!(success.len(), 2, "{success:?}");
        assert_eq!(success[0].1, ["0.50", "not finished"]);
        assert_eq!(success[1].1, ["not run", "not finished"]);
        assert_eq!(rows("Average return")[0].1, ["0.50", "not run"]);
        assert!(tables.iter().all(|table| !table.rows.is_empty()));
    }
}
