//! Frames of a rollout, as the paper's figure 5: of each task the best of our methods with a dmp
//! policy, and DDPG without.

use std::path::{Path, PathBuf};

use anyhow::Context;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use dmprl_shared::config::PolicyKind;
use serde::Serialize;

use super::collect::Results;
use super::measures::Measure;
use super::motion::in_a_line;
use super::run::{Run, Source};
use super::statistics::Summary;
use crate::failure::Outcome;
use crate::motion::Means;
use crate::record::{RecordPlan, record};
use crate::run_directory::{PolicyChoice, RunDirectory, safe_name};
use crate::terminal::StagesProgress;

/// What the paper sets its method beside.
const BESIDE: &str = "DDPG";

/// Frames in a row.
#[derive(Debug, Clone, Serialize)]
pub struct Strip {
    /// In the report's folder, without the ending.
    pub path: String,
    /// For those who do not see it.
    pub alt: String,
    /// The file.
    #[serde(skip)]
    pub png: Vec<u8>,
    /// The same for the page.
    pub base64: String,
}

/// A strip that there is to be, and where it lies once it is made.
#[derive(Debug)]
pub struct Wanted {
    task: String,
    method: String,
    /// None of a landed run: nobody can draw it any more.
    run: Option<RunDirectory>,
    file: PathBuf,
}

/// In a report's folder, without the ending.
fn path(task: &str, method: &str) -> String {
    format!("frames/{}-{}", safe_name(task), safe_name(method))
}

/// The strips of every task whose motion is known.
///
/// # Errors
/// A run cannot be read.
pub fn wanted(results: &Results) -> anyhow::Result<Vec<Wanted>> {
    let mut wanted = Vec::new();
    for task in &results.tasks {
        for run in best_dmp(results, task).into_iter().chain(first_run(results, task, BESIDE)) {
            let (directory, file) = match &run.source {
                Source::Directory(path) => {
                    let directory = RunDirectory::open(path)?;
                    let seed = directory.config()?.evaluation.first_seed;
                    let version = run.last().map_or(0, |row| row.policy_version);
                    // As `record` calls it: drawn once, found again.
                    let name = format!("policy-{version}-seed-{seed}.png");
                    (Some(directory), path.join("videos").join(name))
                }
                // Drawn of the same run: it was the first of its method there, too.
                Source::Report(report) => {
                    (None, report.join(path(&run.task, &run.method) + ".png"))
                }
            };
            let (task, method) = (run.task.clone(), run.method.clone());
            // What could not be rolled out to be measured cannot be to be drawn.
            if run.motion.is_some() || file.is_file() {
                wanted.push(Wanted { task, method, run: directory, file });
            }
        }
    }
    Ok(wanted)
}

/// Whether somebody has to draw any.
#[must_use]
pub fn undrawn(wanted: &[Wanted]) -> bool {
    wanted.iter().any(|wanted| wanted.run.is_some() && !wanted.file.is_file())
}

/// Those of landed runs that an earlier report did not draw.
#[must_use]
pub fn lost_strips(wanted: &[Wanted]) -> Vec<String> {
    let lost = wanted.iter().filter(|wanted| wanted.run.is_none() && !wanted.file.is_file());
    let line = |Wanted { task, method, file, .. }: &Wanted| {
        format!("frames of {task} · {method}: there is no {}", file.display())
    };
    lost.map(line).collect()
}

/// Draws what has not been drawn; what cannot be is left out, with the reason in `undrawn`.
///
/// - `python`: the interpreter that joins the frames.
pub fn draw(
    wanted: &[Wanted],
    (means, python): (&Means, &Path),
    undrawn: &mut Vec<String>,
) -> Outcome {
    let progress = StagesProgress::new();
    for wanted in wanted.iter().filter(|wanted| !wanted.file.is_file()) {
        let Some(run) = &wanted.run else { continue };
        match draw_one(run, means, python, &progress) {
            Ok(Outcome::Done) => {}
            Ok(Outcome::Interrupted) => return Outcome::Interrupted,
            Err(error) => {
                let reason = in_a_line(&error);
                undrawn.push(format!("{} · {}: {reason}", wanted.task, wanted.method));
            }
        }
    }
    Outcome::Done
}

fn draw_one(
    run: &RunDirectory,
    means: &Means,
    python: &Path,
    progress: &StagesProgress,
) -> anyhow::Result<Outcome> {
    let plan = RecordPlan {
        sides: vec![(run, run.choose_policy(PolicyChoice::Latest)?)],
        first_seed: run.config()?.evaluation.first_seed,
        episodes: 1,
        output: run.path().join("videos"),
        means: means.clone(),
        python: python.to_owned(),
    };
    Ok(record(&plan, progress)?.map_or(Outcome::Interrupted, |_| Outcome::Done))
}

/// The strips that there are.
///
/// # Errors
/// One cannot be read.
pub fn strips(wanted: &[Wanted]) -> anyhow::Result<Vec<Strip>> {
    let drawn = wanted.iter().filter(|wanted| wanted.file.is_file());
    let strip = |wanted: &Wanted| {
        let Wanted { task, method, file, .. } = wanted;
        let png = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
        Ok(Strip {
            path: path(task, method),
            alt: format!("{task}: frames of a rollout of {method}"),
            base64: STANDARD.encode(&png),
            png,
        })
    };
    drawn.map(strip).collect()
}

/// Of the methods with a dmp policy the one that ends best; its first run.
fn best_dmp<'r>(results: &'r Results, task: &str) -> Option<&'r Run> {
    let mean = |method: &str, measure: Measure| {
        let scores: Vec<f64> = results.of(task, method).filter_map(|run| measure.of(run)).collect();
        Summary::of(&scores).map(|summary| summary.mean)
    };
    let score = |method: &str| {
        Some((mean(method, Measure::Success).unwrap_or(0.0), mean(method, Measure::Return)?))
    };
    let candidates = results.methods.iter().filter_map(|method| {
        let run = first_run(results, task, method).filter(|run| run.policy == PolicyKind::Dmp)?;
        Some((score(method)?, run))
    });
    let best = candidates.max_by(|(a, _), (b, _)| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    best.map(|(_, run)| run)
}

/// The run of the lowest seed that has come to its end.
fn first_run<'r>(results: &'r Results, task: &str, method: &str) -> Option<&'r Run> {
    let runs = results.runs.iter().filter(|run| run.task == task && run.method == method);
    runs.filter(|run| run.last().is_some()).min_by_key(|run| run.seed)
}

#[cfg(test)]
mod tests {
    use super::super::moves::Moves;
    use super::super::planted::{Planted, planted};
    use super::*;

    #[test]
    fn the_best_method_with_a_dmp_policy_is_shown_by_its_first_run() {
        let run = |method, seed, value| Planted {
            task: "pusher-v0",
            method,
            seed,
            rows: vec![value],
            ended: true,
        };
        let results = planted(&[
            run("SAC", 1, -20.0),
            run("DDPG-DMP", 2, -30.0),
            run("DDPG-DMP", 1, -34.0),
            run("NDP", 1, -47.0),
            run("DDPG", 1, -44.0),
        ]);
        let best = best_dmp(&results, "pusher-v0").unwrap();
        assert_eq!((best.method.as_str(), best.seed), ("DDPG-DMP", 1));
        assert_eq!(first_run(&results, "pusher-v0", BESIDE).unwrap().method, "DDPG");
        assert!(best_dmp(&results, "reacher-v1").is_none());
    }

    #[test]
    fn success_counts_before_return() {
        let run = |method, success| Planted {
            task: "panda-reach",
            method,
            seed: 1,
            rows: vec![success],
            ended: true,
        };
        let mut results = planted(&[run("DDPG-DMP", 0.9), run("TD3-DMP", 1.0)]);
        results.runs[0].rows[0].return_mean = -0.5;
        results.runs[1].rows[0].return_mean = -1.5;
        assert_eq!(best_dmp(&results, "panda-reach").unwrap().method, "TD3-DMP");
    }
    #[test]
    fn a_landed_run_is_shown_by_the_earlier_reports_picture_and_a_missing_one_is_told() {
        let run =
            |method| Planted { task: "panda-reach", method, seed: 1, rows: vec![0.5], ended: true };
        let mut results = planted(&[run("TD3-DMP"), run("DDPG")]);
        let report = tempfile::tempdir().unwrap();
        std::fs::create_dir(report.path().join("frames")).unwrap();
        std::fs::write(report.path().join("frames/panda-reach-TD3-DMP.png"), "pixels").unwrap();
        for run in &mut results.runs {
            run.source = Source::Report(report.path().to_owned());
            run.motion = Some(Moves { joint_jerk: None, sparc: None, rollout: None });
        }
        let wanted = wanted(&results).unwrap();
        assert!(!undrawn(&wanted), "nobody can draw a landed run");
        let strips = strips(&wanted).unwrap();
        assert_eq!(strips.len(), 1);
        assert_eq!(strips[0].path, "frames/panda-reach-TD3-DMP");
        assert_eq!(strips[0].png, b"pixels");
        let lost = lost_strips(&wanted);
        assert_eq!(lost.len(), 1);
        assert!(lost[0].starts_with("frames of panda-reach · DDPG: there is no "), "{lost:?}");
    }
}
