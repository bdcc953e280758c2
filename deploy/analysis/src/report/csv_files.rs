//! Encodes the figures of a report and its runs as CSV.

use super::contents::Report;
use super::run::Run;

/// Encodes `figures.csv`, with a line per table, task and method.
///
/// # Errors
/// Encoding fails, which is not expected: the file is written to memory.
pub fn figures_csv(report: &Report) -> anyhow::Result<Vec<u8>> {
    let mut csv = csv::Writer::from_writer(Vec::new());
    csv.write_record([
        "figure",
        "task",
        "method",
        "seeds",
        "mean",
        "std",
        "iqm",
        "low",
        "high",
        "paper_mean",
        "paper_std",
        "min",
        "max",
        "programs",
        "package_sets",
    ])?;
    for table in &report.tables {
        for (task, cells) in &table.rows {
            for (method, cell) in report.results.methods.iter().zip(cells) {
                let number =
                    |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
                let summary = cell.summary;
                let count = summary.map_or(0, |summary| summary.count).to_string();
                let numbers = [
                    summary.map(|summary| summary.mean),
                    summary.map(|summary| summary.std),
                    summary.and_then(|summary| summary.iqm),
                    summary.and_then(|summary| Some(summary.interval?[0])),
                    summary.and_then(|summary| Some(summary.interval?[1])),
                    cell.paper.map(|paper| paper.0),
                    cell.paper.map(|paper| paper.1),
                    summary.map(|summary| summary.range[0]),
                    summary.map(|summary| summary.range[1]),
                ];
                let words = [table.title, task, method, count.as_str()];
                let words = words.into_iter().map(str::to_owned);
                let software = [cell.software.programs, cell.software.package_sets];
                let software = software.map(|count| count.to_string());
                csv.write_record(words.chain(numbers.map(number)).chain(software))?;
            }
        }
    }
    Ok(csv.into_inner()?)
}

/// Encodes `runs.csv`, with a line per evaluation of each run.
///
/// # Errors
/// Encoding fails, which is not expected: the file is written to memory.
pub fn runs_csv(runs: &[Run]) -> anyhow::Result<Vec<u8>> {
    let mut csv = csv::Writer::from_writer(Vec::new());
    csv.write_record([
        "task",
        "method",
        "seed",
        "env_steps",
        "updates",
        "segments",
        "wall_s",
        "return_mean",
        "success_rate",
        "smoothness",
        "program",
        "packages",
    ])?;
    for run in runs {
        for row in &run.rows {
            csv.write_record([
                run.task.clone(),
                run.method.clone(),
                run.seed.to_string(),
                row.env_steps.to_string(),
                row.updates.to_string(),
                row.segments.to_string(),
                row.wall_s.to_string(),
                row.return_mean.to_string(),
                row.success_rate.map(|rate| rate.to_string()).unwrap_or_default(),
                row.smoothness.to_string(),
                run.origin.programs.join("; "),
                run.origin.packages.join("; "),
            ])?;
        }
    }
    Ok(csv.into_inner()?)
}
