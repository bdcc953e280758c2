//! Results made up for tests.

use super::collect::{Origin, Results, Run};
use crate::control::EvaluationRow;

/// Between two evaluations.
const INTERVAL: u64 = 1_000;

/// One run.
#[derive(Debug, Clone)]
pub(super) struct Planted {
    pub(super) task: &'static str,
    pub(super) method: &'static str,
    pub(super) seed: u64,
    /// Return, or on a Panda task success, of each evaluation; one every 1 000 steps.
    pub(super) rows: Vec<f64>,
    pub(super) ended: bool,
}

/// What these runs are together.
pub(super) fn planted(runs: &[Planted]) -> Results {
    let mut results = Results { planned: runs.len(), ..Results::default() };
    for run in runs {
        for (names, name) in [(&mut results.tasks, run.task), (&mut results.methods, run.method)] {
            if !names.iter().any(|known| known == name) {
                names.push(name.to_owned());
            }
        }
        let rows = run.rows.iter().zip(1..).map(|(value, index)| row(run.task, *value, index));
        results.runs.push(Run {
            task: run.task.to_owned(),
            method: run.method.to_owned(),
            seed: run.seed,
            path: format!("{}-{}-{}", run.task, run.method, run.seed).into(),
            ended: run.ended,
            steps: run.rows.len() as u64 * INTERVAL,
            origin: Origin::default(),
            rows: rows.collect(),
        });
    }
    results
}

fn row(task: &str, value: f64, index: u64) -> EvaluationRow {
    let panda = task.starts_with("panda");
    EvaluationRow {
        env_steps: index * INTERVAL,
        updates: index * INTERVAL,
        segments: index * INTERVAL,
        wall_s: index as f64,
        policy_version: index,
        returns: vec![value],
        return_mean: value,
        success_rate: panda.then_some(value),
        smoothness: 0.1,
    }
}
