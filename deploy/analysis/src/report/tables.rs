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
    /// The measure.
    #[serde(skip)]
    pub measure: Measure,
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
    ///
    /// - `digits`: maximum number of decimals.
    /// - `usual_seeds`: number of seeds that the text above the table mentions.
    #[must_use]
    pub fn lines(&self, digits: usize, usual_seeds: Option<&str>) -> Vec<String> {
        let mut lines = Vec::new();
        match &self.summary {
            None if self.unknown > 0 => lines.push("not measured".to_owned()),
            None if self.unfinished > 0 => lines.push("not finished".to_owned()),
            None => lines.push("not run".to_owned()),
            // With one seed, the standard deviation is unknown, not zero.
            Some(Summary { count: 1, mean, .. }) => lines.push(number(*mean, digits)),
            Some(summary) => {
                let decimals = decimals(summary.std, digits);
                lines.push(mean_and_spread(summary.mean, summary.std, digits));
                if let (Some(iqm), Some(interval)) = (summary.iqm, summary.interval) {
                    let [iqm, low, high] =
                        [iqm, interval[0], interval[1]].map(|value| number(value, decimals));
                    lines.push(format!("{iqm} [{low}, {high}]"));
                }
            }
        }
        lines.extend(self.seeds().filter(|seeds| usual_seeds != Some(seeds)));
        if self.summary.is_some() && self.unknown > 0 {
            lines.push(format!("{} not measured", self.unknown));
        }
        if let Some((mean, std)) = self.paper {
            // As printed.
            lines.push(format!("paper {mean:.digits$} ± {std:.digits$}"));
        }
        lines
    }

    /// Returns the number of seeds as text, with a mark if they are of several programs.
    fn seeds(&self) -> Option<String> {
        let count = self.summary.as_ref()?.count;
        let word = if count == 1 { "seed" } else { "seeds" };
        Some(format!("{count} {word}{}", self.software.mark()))
    }
}

impl Table {
    /// Returns the most frequent number of seeds of a cell as text; `None` without any.
    #[must_use]
    pub fn usual_seeds(&self) -> Option<String> {
        let all: Vec<String> =
            self.rows.iter().flat_map(|(_, cells)| cells).filter_map(Cell::seeds).collect();
        let frequency = |text: &String| all.iter().filter(|other| *other == text).count();
        all.iter().max_by_key(|text| frequency(text)).cloned()
    }

    /// Returns for each cell of a row whether its mean is the best. No cell is the best if only one
    /// has a mean, if all means are equal, or if the measure is a cost.
    #[must_use]
    pub fn best(&self, cells: &[Cell]) -> Vec<bool> {
        let sign = if self.measure.higher_is_better() { 1.0 } else { -1.0 };
        let mean = |cell: &Cell| cell.summary.as_ref().map(|summary| sign * summary.mean);
        let means = || cells.iter().filter_map(mean);
        let best = means().fold(f64::NEG_INFINITY, f64::max);
        let is_ranked = self.measure.kind() != MeasureKind::Cost && means().any(|mean| mean < best);
        cells.iter().map(|cell| is_ranked && mean(cell) == Some(best)).collect()
    }
}

/// Formats a mean and its standard deviation, rounded to one or two digits of the latter.
fn mean_and_spread(mean: f64, std: f64, digits: usize) -> String {
    let decimals = decimals(std, digits);
    format!("{} ± {}", number(mean, decimals), number(std, decimals))
}

/// Returns the number of decimals, at most `digits`, so that a standard deviation has two
/// significant digits if these are at most 35, otherwise one.
fn decimals(std: f64, digits: usize) -> usize {
    if std == 0.0 {
        return digits;
    }
    let magnitude = std.abs().log10().floor();
    let leading = std.abs() / 10_f64.powf(magnitude);
    let significant = if leading < 3.55 { 2.0 } else { 1.0 };
    (significant - 1.0 - magnitude).clamp(0.0, digits as f64) as usize
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
        measure,
        rows: rows.filter(has_measure).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_results};
    use super::*;

    #[test]
    fn cell_shows_an_interval_from_four_seeds_and_marks_several_programs() {
        let run = |seed| FixtureRun {
            task: "point-reach",
            method: "TD3",
            seed,
            rows: vec![-(seed as f64)],
            ended: true,
        };
        let runs: Vec<_> = (1..=4).map(run).collect();
        let lines = |results: &Results| tables(results)[0].rows[0].1[0].lines(1, Some("7 seeds"));
        let mut three = fixture_results(&runs[..3]);
        assert_eq!(lines(&three), ["-2.0 ± 1.0", "3 seeds"]);
        three.runs[0].origin.programs = vec!["0.1.0 (commit 1234)".to_owned()];
        assert_eq!(lines(&three)[1], "3 seeds †");
        three.runs.iter_mut().for_each(|run| run.origin.programs = vec!["0.1.0".to_owned()]);
        assert_eq!(lines(&three)[1], "3 seeds †", "the commits are unknown");
        let known = || "0.1.0 (commit 1234)".to_owned();
        three.runs.iter_mut().for_each(|run| run.origin.programs = vec![known()]);
        three.runs[0].origin.programs = vec![known(), known()];
        three.runs[0].origin.packages.push("Python 3.11.7".to_owned());
        assert_eq!(lines(&three)[1], "3 seeds", "a run was resumed by the same program");
        let mut one = fixture_results(&runs[..1]);
        assert_eq!(lines(&one), ["-1.0", "1 seed"]);
        one.runs[0].origin.programs = vec![known(), "0.1.0 (commit 5678)".to_owned()];
        one.runs[0].origin.packages.push("Python 3.11.7".to_owned());
        assert_eq!(lines(&one), ["-1.0", "1 seed †"]);
        let four = fixture_results(&runs);
        assert!(lines(&four)[1].starts_with("-2.5 ["), "{:?}", lines(&four));
        let mut packages = four;
        packages.runs[3].origin.packages = vec!["Python 3.12.1".to_owned()];
        assert_eq!(lines(&packages)[2], "4 seeds †");
    }

    #[test]
    fn means_are_rounded_like_their_spread() {
        let text = |mean, std| mean_and_spread(mean, std, 2);
        assert_eq!(text(-4.063, 0.112), "-4.06 ± 0.11");
        assert_eq!(text(-23.56, 4.45), "-24 ± 4");
        assert_eq!(text(-5.53, 0.43), "-5.5 ± 0.4");
        assert_eq!(text(-37.52, 2.69), "-37.5 ± 2.7");
        assert_eq!(text(-103.55, 86.87), "-104 ± 87");
        assert_eq!(text(1.0, 0.0), "1.00 ± 0.00");
        assert_eq!(text(0.5, 0.004), "0.50 ± 0.00", "at most the measure's decimals");
        assert_eq!(mean_and_spread(20_000.0, 1_234.0, 0), "20,000 ± 1,234");
    }

    #[test]
    fn best_means_are_marked_where_methods_differ() {
        let run = |method, value| FixtureRun {
            task: "panda-reach",
            method,
            seed: 1,
            rows: vec![value],
            ended: true,
        };
        let results = fixture_results(&[run("TD3", 1.0), run("SAC", 0.5), run("NDP", 1.0)]);
        let table = &tables(&results)[0];
        assert_eq!(table.best(&table.rows[0].1), [true, false, true]);
        assert_eq!(table.best(&table.rows[0].1[..1]), [false], "no other method");
        assert_eq!(table.usual_seeds().as_deref(), Some("1 seed"));
        assert_eq!(table.rows[0].1[0].lines(2, Some("1 seed")), ["1.00"]);
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
                let first = cells.iter().map(|cell| cell.lines(2, None).swap_remove(0));
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
