//! The figures of a report, by task and method.

use serde::Serialize;

use super::collect::{Results, Run};
use super::paper::{Figure, reported};
use super::statistics::Summary;
use crate::control::EvaluationRow;

/// One table: a cell for each task and method.
#[derive(Debug, Clone, Serialize)]
pub struct Table {
    /// What it shows.
    pub title: &'static str,
    /// How it was measured.
    pub about: String,
    /// Digits behind the point.
    pub digits: usize,
    /// (task, its cells in the order of the methods).
    pub rows: Vec<(String, Vec<Cell>)>,
}

/// What is known of one task and method.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Cell {
    /// Over the seeds; none where nothing has come to its end.
    pub summary: Option<Summary>,
    /// Seeds that are not at their end.
    pub unfinished: usize,
    /// Mean and spread in the paper.
    pub paper: Option<(f64, f64)>,
}

impl Cell {
    /// The cell's lines, for people.
    #[must_use]
    pub fn lines(&self, digits: usize) -> Vec<String> {
        let mut lines = Vec::new();
        match &self.summary {
            None if self.unfinished > 0 => lines.push("not finished".to_owned()),
            None => lines.push("not run".to_owned()),
            Some(Summary { count, mean, std, iqm, interval: [low, high] }) => {
                lines.push(format!("{mean:.digits$} ± {std:.digits$}"));
                lines.push(format!("IQM {iqm:.digits$} [{low:.digits$}, {high:.digits$}]"));
                let seeds = if *count == 1 { "seed" } else { "seeds" };
                lines.push(format!("{count} {seeds}"));
            }
        }
        if let Some((mean, std)) = self.paper {
            lines.push(format!("paper {mean:.digits$} ± {std:.digits$}"));
        }
        lines
    }
}

/// Every table that the runs have something for.
#[must_use]
pub fn tables(results: &Results) -> Vec<Table> {
    let at_end = |of: fn(&EvaluationRow) -> Option<f64>| move |run: &Run| run.last().and_then(of);
    let all = [
        table(
            results,
            "Average return",
            "Of the evaluation at the end of each run, without noise.".to_owned(),
            2,
            &at_end(|row| Some(row.return_mean)),
            Some(Figure::Return),
        ),
        table(
            results,
            "Success rate",
            "Share of the last evaluation's episodes that end in success.".to_owned(),
            2,
            &at_end(|row| row.success_rate),
            Some(Figure::Success),
        ),
        table(
            results,
            "Smoothness",
            "Mean absolute change of an action between two steps in the last evaluation, actions \
             scaled to [-1, 1]; lower is smoother."
                .to_owned(),
            3,
            &at_end(|row| Some(row.smoothness)),
            None,
        ),
        table(
            results,
            "Decisions",
            "Segments decided upon in training; an mlp policy decides in every step.".to_owned(),
            0,
            &at_end(|row| Some(row.segments as f64)),
            None,
        ),
        table(
            results,
            "Updates",
            "Of the learner, in training.".to_owned(),
            0,
            &at_end(|row| Some(row.updates as f64)),
            None,
        ),
        table(
            results,
            "Training time [s]",
            "Wall clock of a run; several ran side by side where the machine had cores.".to_owned(),
            0,
            &at_end(|row| Some(row.wall_s)),
            None,
        ),
    ];
    let shows = |table: &Table| {
        table.rows.iter().any(|(_, cells)| cells.iter().any(|cell| cell.summary.is_some()))
    };
    all.into_iter().filter(shows).collect()
}

fn table(
    results: &Results,
    title: &'static str,
    about: String,
    digits: usize,
    score: &dyn Fn(&Run) -> Option<f64>,
    figure: Option<Figure>,
) -> Table {
    let cell = |task: &str, method: &str| {
        let runs = || results.of(task, method);
        let scores: Vec<f64> = runs().filter_map(score).collect();
        Cell {
            summary: Summary::of(&scores),
            unfinished: runs().filter(|run| run.last().is_none()).count(),
            paper: figure.and_then(|figure| reported(figure, task, method)),
        }
    };
    let rows = results.tasks.iter().map(|task| {
        let cells = results.methods.iter().map(|method| cell(task, method));
        (task.clone(), cells.collect())
    });
    Table { title, about, digits, rows: rows.collect() }
}
