//! Expands a sweep file into its runs.

use std::collections::BTreeSet;
use std::path::PathBuf;

use toml::Value;

use super::SweepFile;
use super::file::{MethodEntry, TaskEntry, flatten};
use crate::failure::wrong_use;
use crate::safe_name;

/// Maximum number of runs. A larger number is a mistake in the file.
const RUNS_MAX: usize = 10_000;

/// One run of a sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedRun {
    /// The task's name.
    pub task: String,
    /// The method's label.
    pub method: String,
    /// Point of the grid, as `key=value` pairs.
    pub point: Vec<String>,
    /// `run.seed`.
    pub seed: i64,
    /// Run directory, relative to the sweep's.
    pub directory: PathBuf,
    /// Arguments of `dmprl train`, without the run directory.
    pub arguments: Vec<String>,
}

impl PlannedRun {
    /// One-line title of the run.
    #[must_use]
    pub fn title(&self) -> String {
        let point = self.point.iter().map(|value| format!(" · {value}")).collect::<String>();
        format!("{} · {}{point} · seed {}", self.task, self.method, self.seed)
    }
}

/// All runs in the order of their start: seed by seed, so that each method has a first result
/// early.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Runs in the order of their start.
    pub runs: Vec<PlannedRun>,
}

impl Plan {
    /// Combines tasks × methods × grid × seeds.
    ///
    /// # Errors
    /// Wrong use: too many runs, or two of them with the same directory.
    pub fn new(file: &SweepFile) -> anyhow::Result<Self> {
        let points = points(file);
        let per_seed = file.tasks.len() * file.methods.len();
        let count = per_seed.saturating_mul(points.len()).saturating_mul(file.seeds.len());
        if count > RUNS_MAX {
            return Err(wrong_use(format!("{count} runs in a sweep; expected at most {RUNS_MAX}")));
        }
        let mut runs = Vec::with_capacity(count);
        for &seed in &file.seeds {
            for task in &file.tasks {
                for method in &file.methods {
                    let run = |point| planned(file, task, method, point, seed);
                    runs.extend(points.iter().map(run));
                }
            }
        }
        let mut directories = BTreeSet::new();
        for run in &runs {
            if !directories.insert(&run.directory) {
                let directory = run.directory.display();
                return Err(wrong_use(format!(
                    "two runs of the sweep have the path {directory}: list each task, method, \
                     seed and value only once"
                )));
            }
        }
        Ok(Self { runs })
    }
}

type Point = Vec<(String, Value)>;

/// Returns every combination of the grid's values; without a grid, a single empty one.
fn points(file: &SweepFile) -> Vec<Point> {
    let mut points: Vec<Point> = vec![Vec::new()];
    for (key, values) in flatten(&file.grid) {
        let values = values.as_array().cloned().unwrap_or_default();
        points = points
            .iter()
            .flat_map(|point| {
                values.iter().map(|value| {
                    let mut longer = point.clone();
                    longer.push((key.clone(), value.clone()));
                    longer
                })
            })
            .collect();
        if points.len() > RUNS_MAX {
            break;
        }
    }
    points
}

fn planned(
    file: &SweepFile,
    task: &TaskEntry,
    method: &MethodEntry,
    point: &Point,
    seed: i64,
) -> PlannedRun {
    let mut arguments = arguments(file, task, method, point);
    arguments.extend(["--seed".to_owned(), seed.to_string()]);
    let mut directory = method_directory(task, method);
    if !point.is_empty() {
        let short = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
        let name: Vec<String> =
            point.iter().map(|(key, value)| format!("{}-{value}", short(key))).collect();
        directory.push(safe_name(&name.join("-")));
    }
    PlannedRun {
        task: task.name.clone(),
        method: method.label.clone().unwrap_or_else(|| method.name.clone()),
        point: point.iter().map(|(key, value)| format!("{key}={value}")).collect(),
        seed,
        directory: directory.join(format!("seed-{seed}")),
        arguments,
    }
}

/// Arguments of `dmprl train`, without seed and run directory.
pub(super) fn arguments(
    file: &SweepFile,
    task: &TaskEntry,
    method: &MethodEntry,
    point: &[(String, Value)],
) -> Vec<String> {
    let mut arguments = vec![task.name.clone()];
    let flags =
        [("--algo", &method.algo), ("--policy", &method.policy), ("--preset", &method.preset)];
    for (flag, value) in flags {
        arguments.extend(value.iter().flat_map(|value| [flag.to_owned(), value.clone()]));
    }
    let sets = [&file.set, &task.set, &method.set].into_iter().flat_map(flatten);
    for (key, value) in sets.chain(point.iter().cloned()) {
        arguments.extend(["--set".to_owned(), format!("{key}={value}")]);
    }
    arguments.extend(task.steps.iter().flat_map(|n| ["--steps".to_owned(), n.to_string()]));
    arguments
}

/// Directory of the runs of a task with a method, relative to the sweep's.
pub(super) fn method_directory(task: &TaskEntry, method: &MethodEntry) -> PathBuf {
    PathBuf::from(safe_name(&task.name)).join(safe_name(&method.name))
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = "
        seeds = [1, 2]
        set = { evaluation.episodes = 5 }
        [[task]]
        name = 'reacher'
        steps = 1000
        [[task]]
        name = 'pusher'
        set = { run.steps = 2000 }
        [[method]]
        name = 'paper'
        label = 'DDPG-DMP (paper)'
        algo = 'ddpg'
        preset = 'paper'
        [[method]]
        name = 'mlp'
        policy = 'mlp'
        set = { exploration.std = 0.2 }
        [grid]
        algorithm.batch_size = [64, 128]
    ";

    fn plan(text: &str) -> anyhow::Result<Plan> {
        Plan::new(&toml::from_str(text).unwrap())
    }

    #[test]
    fn each_combination_runs_once_ordered_by_seed() {
        let runs = plan(FILE).unwrap().runs;
        assert_eq!(runs.len(), 2 * 2 * 2 * 2);
        assert!(runs[..8].iter().all(|run| run.seed == 1));
        let words = |run: &PlannedRun| run.arguments.join(" ");
        assert_eq!(
            words(&runs[0]),
            "reacher --algo ddpg --preset paper --set evaluation.episodes=5 \
             --set algorithm.batch_size=64 --steps 1000 --seed 1"
        );
        assert_eq!(
            words(&runs[15]),
            "pusher --policy mlp --set evaluation.episodes=5 --set run.steps=2000 \
             --set exploration.std=0.2 --set algorithm.batch_size=128 --seed 2"
        );
        assert_eq!(runs[0].directory.to_str(), Some("reacher/paper/batch_size-64/seed-1"));
        assert_eq!(
            runs[0].title(),
            "reacher · DDPG-DMP (paper) · algorithm.batch_size=64 · seed 1"
        );
    }

    #[test]
    fn runs_with_the_same_directory_are_rejected() {
        let error = plan(&FILE.replace("[1, 2]", "[1, 1]")).unwrap_err().to_string();
        assert!(error.contains("seed-1"), "{error}");
        let error = plan(&FILE.replace("'mlp'\n        policy", "'paper'\n        policy"));
        assert!(error.unwrap_err().to_string().contains("reacher/paper"));
    }

    #[test]
    fn a_grid_that_is_too_large_is_rejected() {
        let many: Vec<String> = (0..200).map(|value| value.to_string()).collect();
        let grid = format!("a.b = [{0}]\nc.d = [{0}]", many.join(","));
        let error = plan(&FILE.replace("algorithm.batch_size = [64, 128]", &grid));
        assert!(error.unwrap_err().to_string().contains("at most 10000"));
    }
}
