//! Shows frames of a rollout as in the paper's Figure 5: for each task, of the best method with a
//! dmp policy, and of DDPG for comparison.

use std::path::PathBuf;

use anyhow::Context;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use dmprl_run::failure::Outcome;
use dmprl_run::{RunDirectory, safe_name};
use dmprl_shared::config::PolicyKind;
use serde::Serialize;

use super::motion::in_one_line;
use super::results::Results;
use super::run::{Run, Source};

/// The method that the paper's Figure 5 compares with its own.
const BASELINE: &str = "DDPG";

/// A row of frames.
#[derive(Debug, Clone, Serialize)]
pub struct Filmstrip {
    /// Task.
    pub task: String,
    /// Method.
    pub method: String,
    /// Path relative to the folder of the report, without the extension.
    pub path: String,
    /// Alternative text.
    pub alt: String,
    /// Content of the PNG file.
    #[serde(skip)]
    pub png: Vec<u8>,
    /// The same in Base64, for the page.
    pub base64: String,
}

impl Filmstrip {
    /// Returns true if the other is of the same task.
    pub(super) fn is_of_same_task(&self, other: &Self) -> bool {
        self.task == other.task
    }
}

/// A filmstrip that the report shows if its file exists.
#[derive(Debug)]
pub struct PlannedFilmstrip {
    task: String,
    method: String,
    /// `None` if the run was read from an earlier report, and therefore cannot be recorded.
    run: Option<RunDirectory>,
    file: PathBuf,
}

/// Returns the path of a filmstrip relative to the folder of a report, without the extension.
fn path(task: &str, method: &str) -> String {
    format!("frames/{}-{}", safe_name(task), safe_name(method))
}

/// Plans the filmstrips of each task.
///
/// # Errors
/// A run cannot be read.
pub fn plan_filmstrips(results: &Results) -> anyhow::Result<Vec<PlannedFilmstrip>> {
    let mut planned = Vec::new();
    for task in &results.tasks {
        for run in best_dmp(results, task).into_iter().chain(first_run(results, task, BASELINE)) {
            let (directory, file) = match &run.source {
                Source::Directory(path) => {
                    let directory = RunDirectory::open(path)?;
                    let seed = directory.config()?.evaluation.first_seed;
                    let version = run.last().map_or(0, |row| row.policy_version);
                    // The name that `dmprl_sweep::record` chooses, so that an existing recording is
                    // found.
                    let name = format!("policy-{version}-seed-{seed}.png");
                    (Some(directory), path.join("videos").join(name))
                }
                // The earlier report has the filmstrip, as it chose the same run.
                Source::Report(report) => {
                    (None, report.join(path(&run.task, &run.method) + ".png"))
                }
            };
            let (task, method) = (run.task.clone(), run.method.clone());
            // Skips runs whose motion rollout failed, because a recording would fail too.
            if run.motion.is_some() || file.is_file() {
                planned.push(PlannedFilmstrip { task, method, run: directory, file });
            }
        }
    }
    Ok(planned)
}

/// Returns true if [`record_filmstrips`] would record something.
#[must_use]
pub fn needs_recording(planned: &[PlannedFilmstrip]) -> bool {
    planned.iter().any(|filmstrip| filmstrip.run.is_some() && !filmstrip.file.is_file())
}

/// Lists the planned filmstrips that an earlier report does not have.
#[must_use]
pub fn missing_filmstrips(planned: &[PlannedFilmstrip]) -> Vec<String> {
    let missing =
        planned.iter().filter(|filmstrip| filmstrip.run.is_none() && !filmstrip.file.is_file());
    let line = |PlannedFilmstrip { task, method, file, .. }: &PlannedFilmstrip| {
        format!("frames of {task} · {method}: there is no {}", file.display())
    };
    missing.map(line).collect()
}

/// Records the filmstrips that do not exist yet. If a recording fails, appends the reason to
/// `undrawn` and continues.
///
/// - `record`: records the first evaluation episode of the run's latest policy to the folder
///   `videos` of the run directory.
pub fn record_filmstrips(
    planned: &[PlannedFilmstrip],
    undrawn: &mut Vec<String>,
    mut record: impl FnMut(&RunDirectory) -> anyhow::Result<Outcome>,
) -> Outcome {
    for filmstrip in planned.iter().filter(|filmstrip| !filmstrip.file.is_file()) {
        let Some(run) = &filmstrip.run else { continue };
        match record(run) {
            Ok(Outcome::Done) => {}
            Ok(Outcome::Interrupted) => return Outcome::Interrupted,
            Err(error) => {
                let reason = in_one_line(&error);
                undrawn.push(format!("{} · {}: {reason}", filmstrip.task, filmstrip.method));
            }
        }
    }
    Outcome::Done
}

/// Reads the existing filmstrips.
///
/// # Errors
/// A file cannot be read.
pub fn read_filmstrips(planned: &[PlannedFilmstrip]) -> anyhow::Result<Vec<Filmstrip>> {
    let existing = planned.iter().filter(|filmstrip| filmstrip.file.is_file());
    let read = |filmstrip: &PlannedFilmstrip| {
        let PlannedFilmstrip { task, method, file, .. } = filmstrip;
        let png = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
        Ok(Filmstrip {
            task: task.clone(),
            method: method.clone(),
            path: path(task, method),
            alt: format!("{task}: frames of a rollout of {method}"),
            base64: STANDARD.encode(&png),
            png,
        })
    };
    existing.map(read).collect()
}

/// Returns the finished run with the lowest seed of the best method with a dmp policy.
fn best_dmp<'r>(results: &'r Results, task: &str) -> Option<&'r Run> {
    let candidates = results.methods.iter().filter_map(|method| {
        let run = first_run(results, task, method).filter(|run| run.policy == PolicyKind::Dmp)?;
        Some((results.score(task, method)?, run))
    });
    let best = candidates.max_by(|(a, _), (b, _)| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    best.map(|(_, run)| run)
}

/// Returns the finished run of a method with the lowest seed.
pub(super) fn first_run<'r>(results: &'r Results, task: &str, method: &str) -> Option<&'r Run> {
    let finished = results.runs.iter().filter(|run| run.last().is_some());
    let runs = finished.filter(|run| run.task == task && run.method == method);
    runs.min_by_key(|run| run.seed)
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_results};
    use super::super::motion_metrics::MotionMetrics;
    use super::*;

    #[test]
    fn best_method_with_a_dmp_policy_is_shown_with_its_lowest_seed() {
        let run = |method, seed, value| FixtureRun {
            task: "pusher-v0",
            method,
            seed,
            rows: vec![value],
            ended: true,
        };
        let results = fixture_results(&[
            run("SAC", 1, -20.0),
            run("DDPG-DMP", 2, -30.0),
            run("DDPG-DMP", 1, -34.0),
            run("NDP", 1, -47.0),
            run("DDPG", 1, -44.0),
        ]);
        let best = best_dmp(&results, "pusher-v0").unwrap();
        assert_eq!((best.method.as_str(), best.seed), ("DDPG-DMP", 1));
        assert_eq!(first_run(&results, "pusher-v0", BASELINE).unwrap().method, "DDPG");
        assert!(best_dmp(&results, "reacher-v1").is_none());
    }

    #[test]
    fn success_rate_takes_precedence_over_return() {
        let run = |method, success| FixtureRun {
            task: "panda-reach",
            method,
            seed: 1,
            rows: vec![success],
            ended: true,
        };
        let mut results = fixture_results(&[run("DDPG-DMP", 0.9), run("TD3-DMP", 1.0)]);
        results.runs[0].rows[0].return_mean = -0.5;
        results.runs[1].rows[0].return_mean = -1.5;
        assert_eq!(best_dmp(&results, "panda-reach").unwrap().method, "TD3-DMP");
    }

    #[test]
    fn filmstrip_of_an_earlier_report_is_reused() {
        let run = |method| FixtureRun {
            task: "panda-reach",
            method,
            seed: 1,
            rows: vec![0.5],
            ended: true,
        };
        let mut results = fixture_results(&[run("TD3-DMP"), run("DDPG")]);
        let report = tempfile::tempdir().unwrap();
        std::fs::create_dir(report.path().join("frames")).unwrap();
        std::fs::write(report.path().join("frames/panda-reach-TD3-DMP.png"), "pixels").unwrap();
        for run in &mut results.runs {
            run.source = Source::Report(report.path().to_owned());
            run.motion = Some(MotionMetrics {
                action_acceleration: None,
                joint_jerk: None,
                sparc: None,
                rollout: None,
            });
        }
        let planned = plan_filmstrips(&results).unwrap();
        assert!(!needs_recording(&planned), "its directory is not available");
        let filmstrips = read_filmstrips(&planned).unwrap();
        assert_eq!(filmstrips.len(), 1);
        assert_eq!(filmstrips[0].path, "frames/panda-reach-TD3-DMP");
        assert_eq!(filmstrips[0].png, b"pixels");
        let missing = missing_filmstrips(&planned);
        assert_eq!(missing.len(), 1);
        assert!(
            missing[0].starts_with("frames of panda-reach · DDPG: there is no "),
            "{missing:?}"
        );
    }
}
