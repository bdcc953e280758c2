//! `curves.json`: all that a report knows of its runs, a line each, and back.
//!
//! Directories of runs are large and lie where they were trained. The folder of a report is small
//! and can be committed or sent, so it stands in for them in a later report: a sweep that is
//! continued elsewhere, or done by several machines, ends as one comparison. Figures are written in
//! full, so that no table's digit depends on whether a run was landed.

use std::fs;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use dmprl_shared::config::PolicyKind;
use serde::{Deserialize, Serialize};

use super::collect::Results;
use super::moves::Moves;
use super::run::{Key, Origin, Run, Source};
use super::trajectories::is_drawn;
use crate::control::EvaluationRow;

/// By which the folder of a report is known.
pub const FILE: &str = "curves.json";
/// Version of the file that is written.
const FORMAT_VERSION: u32 = 3;
/// Oldest version that is read. It lacks final episodes, packages and hashes.
const FORMAT_VERSION_MIN: u32 = 2;

/// What every version of the file begins with.
#[derive(Debug, Deserialize)]
struct Versioned {
    format_version: u32,
}

/// The file without its runs, which it ends with.
#[derive(Debug, Serialize)]
struct Head<'r> {
    format_version: u32,
    tasks: &'r [String],
    methods: &'r [String],
    sweeps: &'r [(String, String)],
    waiting: &'r [Key],
}

/// The file as it is read.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Document {
    #[serde(rename = "format_version")]
    _format_version: u32,
    tasks: Vec<String>,
    methods: Vec<String>,
    sweeps: Vec<(String, String)>,
    waiting: Vec<Key>,
    /// Read one by one: an error then names the run.
    runs: Vec<serde_json::Value>,
}

/// One run; the arrays have an element an evaluation.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    task: String,
    method: String,
    seed: u64,
    policy: PolicyKind,
    /// Environment steps that it was asked for.
    steps: u64,
    /// Whether it has come to its end.
    ended: bool,
    origin: Origin,
    env_steps: Vec<u64>,
    updates: Vec<u64>,
    segments: Vec<u64>,
    wall_s: Vec<f64>,
    return_mean: Vec<f64>,
    /// Null where the task reports none.
    success_rate: Option<Vec<f64>>,
    smoothness: Vec<f64>,
    /// Episodes of the last evaluation.
    #[serde(default)]
    final_episodes: Option<u64>,
    motion: Option<Moves>,
}

impl Line {
    /// Of rollouts only the one that the report draws: the others would make the file large.
    fn of(run: &Run, results: &Results) -> Self {
        let mut motion = run.motion.clone();
        if let Some(motion) = &mut motion
            && !is_drawn(results, run)
        {
            motion.rollout = None;
        }
        let numbers = |of: fn(&EvaluationRow) -> f64| run.rows.iter().map(of).collect();
        let counts = |of: fn(&EvaluationRow) -> u64| run.rows.iter().map(of).collect();
        Self {
            task: run.task.clone(),
            method: run.method.clone(),
            seed: run.seed,
            policy: run.policy,
            steps: run.steps,
            ended: run.ended,
            origin: run.origin.clone(),
            env_steps: counts(|row| row.env_steps),
            updates: counts(|row| row.updates),
            segments: counts(|row| row.segments),
            wall_s: numbers(|row| row.wall_s),
            return_mean: numbers(|row| row.return_mean),
            success_rate: run.rows.iter().map(|row| row.success_rate).collect(),
            smoothness: numbers(|row| row.smoothness),
            final_episodes: run.final_episodes,
            motion,
        }
    }

    fn check(&self) -> anyhow::Result<()> {
        let count = self.env_steps.len();
        let lengths = [
            ("updates", self.updates.len()),
            ("segments", self.segments.len()),
            ("wall_s", self.wall_s.len()),
            ("return_mean", self.return_mean.len()),
            ("success_rate", self.success_rate.as_ref().map_or(count, Vec::len)),
            ("smoothness", self.smoothness.len()),
        ];
        for (name, length) in lengths {
            ensure!(
                length == count,
                "{name} has {length} evaluations, expected {count} as env_steps"
            );
        }
        ensure!(
            self.env_steps.is_sorted(),
            "env_steps goes back, expected evaluations in the order in which they were made"
        );
        ensure!(count > 0 || !self.ended, "it is ended without an evaluation, expected one");
        let rollout = self.motion.as_ref().and_then(|motion| motion.rollout.as_ref());
        rollout.map_or(Ok(()), super::moves::Rollout::check)
    }

    fn run(self, source: Source) -> Run {
        let row = |index: usize| EvaluationRow {
            env_steps: self.env_steps[index],
            updates: self.updates[index],
            segments: self.segments[index],
            wall_s: self.wall_s[index],
            // Of use only beside the policies' files and for single episodes, which are not landed.
            policy_version: 0,
            returns: Vec::new(),
            return_mean: self.return_mean[index],
            success_rate: self.success_rate.as_ref().map(|rates| rates[index]),
            smoothness: self.smoothness[index],
        };
        let rows = (0..self.env_steps.len()).map(row).collect();
        let Self {
            task, method, seed, policy, steps, ended, origin, final_episodes, motion, ..
        } = self;
        Run {
            task,
            method,
            policy,
            seed,
            source,
            ended,
            steps,
            origin,
            rows,
            final_episodes,
            motion,
        }
    }
}

/// The file's text.
///
/// # Errors
/// None is known: it is written into memory.
pub fn curves_json(results: &Results) -> anyhow::Result<Vec<u8>> {
    let Results { tasks, methods, sweeps, waiting, .. } = results;
    let head = Head { format_version: FORMAT_VERSION, tasks, methods, sweeps, waiting };
    let head = serde_json::to_string(&head)?;
    let head = head.trim_end_matches('}');
    let lines = results.runs.iter().map(|run| serde_json::to_string(&Line::of(run, results)));
    let lines: Vec<String> = lines.collect::<Result<_, _>>()?;
    Ok(format!("{head},\"runs\":[\n{}\n]}}\n", lines.join(",\n")).into_bytes())
}

/// What the report in a folder knew: its tasks, methods, sweeps and runs.
///
/// # Errors
/// The file cannot be read, is of another format, or is damaged.
pub fn read(report: &Path) -> anyhow::Result<Results> {
    let path = report.join(FILE);
    let name = path.display();
    let text = fs::read_to_string(&path).with_context(|| format!("cannot read {name}"))?;
    let Versioned { format_version } =
        serde_json::from_str(&text).with_context(|| format!("{name} is no report's file"))?;
    match format_version {
        FORMAT_VERSION_MIN..=FORMAT_VERSION => {}
        ..FORMAT_VERSION_MIN => bail!(
            "{name} is of format {format_version}, expected {FORMAT_VERSION}: it holds no more \
             than curves; make that report again, from its runs, with this program"
        ),
        _ => bail!(
            "{name} is of format {format_version}, expected {FORMAT_VERSION}: a newer program made \
             it; use that one, or a newer one"
        ),
    }
    let document: Document =
        serde_json::from_str(&text).with_context(|| format!("{name} is damaged"))?;
    let Document { tasks, methods, sweeps, waiting, runs, .. } = document;
    let mut results = Results { tasks, methods, sweeps, waiting, ..Results::default() };
    for (value, number) in runs.into_iter().zip(1..) {
        let which = format!("{name}, run {number} ({})", title(&value));
        let line: Line = serde_json::from_value(value).with_context(|| which.clone())?;
        line.check().with_context(|| which.clone())?;
        ensure!(
            results.tasks.contains(&line.task) && results.methods.contains(&line.method),
            "{which}: its task or method is not in the lists at the file's beginning"
        );
        results.runs.push(line.run(Source::Report(report.to_owned())));
    }
    Ok(results)
}

/// What a damaged run says that it is.
fn title(run: &serde_json::Value) -> String {
    let parts = ["task", "method", "seed"].map(|key| run[key].to_string());
    parts.join(" · ").replace('"', "")
}

#[cfg(test)]
mod tests {
    use super::super::planted::{Planted, planted, planted_moves};
    use super::super::tables::tables;
    use super::*;

    /// Two that have ended, of which one has joints, and one that has just begun.
    fn results() -> Results {
        let run = |task, seed, rows: &[f64], ended| Planted {
            task,
            method: "TD3",
            seed,
            rows: rows.to_vec(),
            ended,
        };
        let mut results = planted(&[
            run("reacher-v1", 1, &[-1.000_049, -0.1 - 0.2], true),
            run("panda-reach", 2, &[0.0, 1.0 / 3.0], true),
            run("panda-reach", 3, &[], false),
        ]);
        results.runs[0].motion = Some(planted_moves(1.0 / 3.0, -2.0));
        results.waiting = vec![Key { seed: 9, ..results.runs[0].key() }];
        results.sweeps = vec![("paper".to_owned(), "seeds = [1]\n".to_owned())];
        results
    }

    fn written(text: &[u8]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(FILE), text).unwrap();
        folder
    }

    #[test]
    fn what_is_read_says_to_the_last_digit_what_was_written() {
        let results = results();
        let text = curves_json(&results).unwrap();
        assert_eq!(text.iter().filter(|byte| **byte == b'\n').count(), 5, "one line a run");
        let folder = written(&text);
        let landed = read(folder.path()).unwrap();
        assert_eq!(String::from_utf8(curves_json(&landed).unwrap()), String::from_utf8(text));
        let json = |results| serde_json::to_string(&tables(results)).unwrap();
        assert_eq!(json(&landed), json(&results));
        let [ours, theirs] = [&results, &landed].map(|results| {
            let runs = results.runs.iter();
            runs.map(|run| (run.key(), run.motion.clone(), run.last().is_some()))
                .collect::<Vec<_>>()
        });
        assert_eq!(ours, theirs);
        assert!(landed.runs.iter().all(|run| run.directory().is_none()));
    }

    #[test]
    fn a_file_of_the_version_before_is_read_without_what_it_lacks() {
        let text = String::from_utf8(curves_json(&results()).unwrap()).unwrap();
        let older = text
            .replace("\"format_version\":3", "\"format_version\":2")
            .replace("\"final_episodes\":100,", "")
            .replace(",\"packages\":[\"Python 3.11.7\"],\"config_sha256\":null", "");
        assert!(!older.contains("packages") && !older.contains("final_episodes"), "{older}");
        let landed = read(written(older.as_bytes()).path()).unwrap();
        assert_eq!(landed.runs.len(), 3);
        assert!(landed.runs.iter().all(|run| run.final_episodes.is_none()));
    }

    #[test]
    fn of_the_rollouts_only_the_one_that_is_drawn_is_landed() {
        let mut results = results();
        let mut second = results.runs[0].clone();
        second.seed = 2;
        results.runs.push(second);
        let folder = written(&curves_json(&results).unwrap());
        let landed = read(folder.path()).unwrap();
        let motion = |index: usize| landed.runs[index].motion.as_ref().unwrap();
        assert!(motion(0).rollout.is_some() && motion(3).rollout.is_none());
        assert_eq!(motion(3).sparc, Some(-2.0));
    }

    #[test]
    fn damage_is_refused_with_file_and_run_and_another_format_with_its_version() {
        let text = String::from_utf8(curves_json(&results()).unwrap()).unwrap();
        let run = "run 1 (reacher-v1 · TD3 · 1)";
        for (from, to, expected) in [
            ("\"updates\":[1000,2000]", "\"updates\":[1000]", "updates has 1 evaluations"),
            ("\"updates\":[1000,2000]", "\"updates\":[1000,null]", "expected u64"),
            ("\"env_steps\":[1000,2000]", "\"env_steps\":[2000,1000]", "env_steps goes back"),
            (",[4.0]]", "]", "3 rows of positions and 2 of velocities"),
            (",[0.3]]", ",[0.3,0.3]]", "rows that are not of its 1 joints"),
            ("\"policy\":\"mlp\"", "\"policy\":\"table\"", "unknown variant"),
        ] {
            assert!(text.contains(from), "{from}");
            let folder = written(text.replacen(from, to, 1).as_bytes());
            let error = format!("{:#}", read(folder.path()).unwrap_err());
            for part in [FILE, run, expected] {
                assert!(error.contains(part), "{part} is not in: {error}");
            }
        }
        for (from, to, expected) in [
            ("\"format_version\":3", "\"format_version\":1", "it holds no more than curves"),
            ("\"format_version\":3", "\"format_version\":4", "of format 4, expected 3: a newer"),
            ("\"format_version\":3", "\"version\":3", "is no report's file"),
            ("\"methods\":[\"TD3\"]", "\"methods\":[]", "not in the lists"),
            ("-1.000049", "1e999", "number out of range"),
        ] {
            let folder = written(text.replacen(from, to, 1).as_bytes());
            let error = format!("{:#}", read(folder.path()).unwrap_err());
            assert!(error.contains(FILE) && error.contains(expected), "{error}");
        }
        let ended = text.replacen("\"ended\":false", "\"ended\":true", 1);
        let error = format!("{:#}", read(written(ended.as_bytes()).path()).unwrap_err());
        assert!(error.contains("run 3") && error.contains("without an evaluation"), "{error}");
    }
}
