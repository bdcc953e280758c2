//! The report's figures for other programs: CSV, and the curves as JSON.

use serde::Serialize;

use super::collect::Run;
use super::page::Report;

/// Of `curves.json`.
const FORMAT_VERSION: u32 = 1;
/// Decimals of a mean: what is beyond them no picture shows, and a small file can be committed.
const DECIMALS: f64 = 1e4;

/// One line a figure, task and method.
///
/// # Errors
/// None is known: it is written into memory.
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
    ])?;
    for table in &report.tables {
        for (task, cells) in &table.rows {
            for (method, cell) in report.results.methods.iter().zip(cells) {
                let number =
                    |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
                let summary = cell.summary;
                let count = summary.map_or(0, |summary| summary.count).to_string();
                let of = [
                    summary.map(|summary| summary.mean),
                    summary.map(|summary| summary.std),
                    summary.map(|summary| summary.iqm),
                    summary.map(|summary| summary.interval[0]),
                    summary.map(|summary| summary.interval[1]),
                    cell.paper.map(|paper| paper.0),
                    cell.paper.map(|paper| paper.1),
                ];
                let words = [table.title, task, method, count.as_str()];
                let words = words.into_iter().map(str::to_owned);
                csv.write_record(words.chain(of.map(number)))?;
            }
        }
    }
    Ok(csv.into_inner()?)
}

/// One line an evaluation of a run.
///
/// # Errors
/// None is known: it is written into memory.
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
            ])?;
        }
    }
    Ok(csv.into_inner()?)
}

/// One run's learning curve.
#[derive(Debug, Serialize)]
struct Curve<'r> {
    task: &'r str,
    method: &'r str,
    seed: u64,
    /// Whether the run has come to its end.
    ended: bool,
    env_steps: Vec<u64>,
    return_mean: Vec<f64>,
    /// Null where the task reports none.
    success_rate: Option<Vec<f64>>,
}

impl<'r> Curve<'r> {
    fn of(run: &'r Run) -> Self {
        let rounded = |value: f64| (value * DECIMALS).round() / DECIMALS;
        Self {
            task: &run.task,
            method: &run.method,
            seed: run.seed,
            ended: run.ended,
            env_steps: run.rows.iter().map(|row| row.env_steps).collect(),
            return_mean: run.rows.iter().map(|row| rounded(row.return_mean)).collect(),
            success_rate: run.rows.iter().map(|row| row.success_rate.map(rounded)).collect(),
        }
    }
}

/// Every run's learning curve: small enough to be committed, one run a line.
///
/// # Errors
/// None is known: it is written into memory.
pub fn curves_json(runs: &[Run]) -> anyhow::Result<Vec<u8>> {
    let runs = runs.iter().filter(|run| !run.rows.is_empty());
    let lines: Vec<String> =
        runs.map(|run| serde_json::to_string(&Curve::of(run))).collect::<Result<_, _>>()?;
    let head = format!("{{\"format_version\": {FORMAT_VERSION}, \"runs\": [\n");
    Ok(format!("{head}{}\n]}}\n", lines.join(",\n")).into_bytes())
}

#[cfg(test)]
mod tests {
    use super::super::planted::{Planted, planted};
    use super::*;

    #[test]
    fn curves_are_json_with_a_line_a_run_and_no_digits_that_nobody_sees() {
        let run = |task, seed| Planted {
            task,
            method: "TD3",
            seed,
            rows: vec![-1.000_049, 0.123_456],
            ended: true,
        };
        let results = planted(&[run("reacher-v1", 1), run("panda-reach", 2)]);
        let bytes = curves_json(&results.runs).unwrap();
        assert_eq!(bytes.iter().filter(|byte| **byte == b'\n').count(), 4);
        let json: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
        assert_eq!(json["runs"][0]["return_mean"], serde_json::json!([-1.0, 0.1235]));
        assert_eq!(json["runs"][0]["env_steps"], serde_json::json!([1000, 2000]));
        assert!(json["runs"][0]["success_rate"].is_null());
        assert_eq!(json["runs"][1]["success_rate"], serde_json::json!([-1.0, 0.1235]));
    }
}
