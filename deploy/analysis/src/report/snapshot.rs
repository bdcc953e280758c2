//! Writes and reads `report-data.json`, which has all data of a report's runs, one run per line.
//!
//! Run directories are large and stay on the machine that trained them. The folder of a report is
//! small and can be committed or copied. A later report can read it instead of the run directories,
//! for example to combine the parts of a sweep from several machines. Numbers are written with all
//! digits, so that the tables of both reports are the same.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use dmprl_shared::config::PolicyKind;
use dmprl_shared::supervision::EvaluationRow;
use serde::{Deserialize, Serialize};

use super::motion_metrics::{MotionMetrics, Rollout};
use super::results::Results;
use super::run::{Origin, Run, RunKey, Source};

/// Name of the file in the folder of a report.
pub(super) const FILE: &str = "report-data.json";
/// Name of the file in older reports.
const OLD_FILE: &str = "curves.json";
/// Version of the format written.
const FORMAT_VERSION: u32 = 3;
/// Oldest version that can be read. It has no final episodes, packages and hashes.
const FORMAT_VERSION_MIN: u32 = 2;

/// The part that all versions of the file have.
#[derive(Debug, Deserialize)]
struct Versioned {
    format_version: u32,
}

/// The beginning of the file, before the runs.
#[derive(Debug, Serialize)]
struct Head<'r> {
    format_version: u32,
    tasks: &'r [String],
    methods: &'r [String],
    sweeps: &'r [(String, String)],
    waiting: &'r [RunKey],
}

/// The whole file, for reading.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Document {
    #[serde(rename = "format_version")]
    _format_version: u32,
    tasks: Vec<String>,
    methods: Vec<String>,
    sweeps: Vec<(String, String)>,
    waiting: Vec<RunKey>,
    /// Parsed one by one, so that an error names the run.
    runs: Vec<serde_json::Value>,
}

/// One run; each array has an element per evaluation.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RunRecord {
    task: String,
    method: String,
    seed: u64,
    policy: PolicyKind,
    /// Configured environment steps.
    steps: u64,
    /// Whether the run is finished.
    ended: bool,
    origin: Origin,
    env_steps: Vec<u64>,
    updates: Vec<u64>,
    segments: Vec<u64>,
    wall_s: Vec<f64>,
    return_mean: Vec<f64>,
    /// Null if the task does not report success.
    success_rate: Option<Vec<f64>>,
    smoothness: Vec<f64>,
    /// Number of episodes in the last evaluation.
    #[serde(default)]
    final_episodes: Option<u64>,
    motion: Option<MotionMetrics>,
}

impl RunRecord {
    /// Copies the data of a run. Rollouts that the report does not draw are dropped, to keep the
    /// file small.
    fn new(run: &Run, results: &Results) -> Self {
        let mut motion = run.motion.clone();
        if let Some(motion) = &mut motion
            && !results.is_shown(run)
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

    /// Checks that the arrays fit together.
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
                "{name} has {length} evaluations, expected {count} as in env_steps"
            );
        }
        ensure!(
            self.env_steps.is_sorted(),
            "env_steps decreases; expected evaluations in chronological order"
        );
        ensure!(count > 0 || !self.ended, "the run is finished without an evaluation");
        let rollout = self.motion.as_ref().and_then(|motion| motion.rollout.as_ref());
        rollout.map_or(Ok(()), Rollout::check)
    }

    fn run(self, source: Source) -> Run {
        let row = |index: usize| EvaluationRow {
            env_steps: self.env_steps[index],
            updates: self.updates[index],
            segments: self.segments[index],
            wall_s: self.wall_s[index],
            // The file has neither policy versions nor single episodes.
            policy_version: 0,
            returns: Vec::new(),
            return_mean: self.return_mean[index],
            success_rate: self.success_rate.as_ref().map(|rates| rates[index]),
            smoothness: self.smoothness[index],
            at_bounds: None,
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

/// Encodes the file.
///
/// # Errors
/// Serialization fails, which is not expected.
pub(super) fn encode(results: &Results) -> anyhow::Result<Vec<u8>> {
    let Results { tasks, methods, sweeps, not_started: waiting, .. } = results;
    let head = Head { format_version: FORMAT_VERSION, tasks, methods, sweeps, waiting };
    let head = serde_json::to_string(&head)?;
    let head = head.trim_end_matches('}');
    let runs = results.runs.iter().map(|run| RunRecord::new(run, results));
    let lines = runs.map(|run| serde_json::to_string(&run));
    let lines: Vec<String> = lines.collect::<Result<_, _>>()?;
    Ok(format!("{head},\"runs\":[\n{}\n]}}\n", lines.join(",\n")).into_bytes())
}

/// Returns the path of the file in the folder of a report, under its current or its old name.
pub(super) fn find(report: &Path) -> Option<PathBuf> {
    [FILE, OLD_FILE].map(|name| report.join(name)).into_iter().find(|path| path.is_file())
}

/// Reads the tasks, methods, sweeps and runs of an earlier report.
///
/// # Errors
/// The file cannot be read, has another format, or is invalid.
pub(super) fn read(path: &Path) -> anyhow::Result<Results> {
    let report = path.parent().unwrap_or(Path::new("."));
    let name = path.display();
    let text = fs::read_to_string(path).with_context(|| format!("cannot read {name}"))?;
    let Versioned { format_version } = serde_json::from_str(&text)
        .with_context(|| format!("{name} is not the data of a report"))?;
    match format_version {
        FORMAT_VERSION_MIN..=FORMAT_VERSION => {}
        ..FORMAT_VERSION_MIN => bail!(
            "{name} has format {format_version}, expected {FORMAT_VERSION_MIN} to \
             {FORMAT_VERSION}: it contains only curves; recreate that report from its runs with \
             this program"
        ),
        _ => bail!(
            "{name} has format {format_version}, expected {FORMAT_VERSION_MIN} to \
             {FORMAT_VERSION}: it was written by a newer program; use that program"
        ),
    }
    let document: Document =
        serde_json::from_str(&text).with_context(|| format!("{name} is invalid"))?;
    let Document { tasks, methods, sweeps, waiting: not_started, runs, .. } = document;
    let mut results = Results { tasks, methods, sweeps, not_started, ..Results::default() };
    for (value, number) in runs.into_iter().zip(1..) {
        let which = format!("{name}, run {number} ({})", title(&value));
        let record: RunRecord = serde_json::from_value(value).with_context(|| which.clone())?;
        record.check().with_context(|| which.clone())?;
        ensure!(
            results.tasks.contains(&record.task) && results.methods.contains(&record.method),
            "{which}: its task or method is not in the lists at the start of the file"
        );
        results.runs.push(record.run(Source::Report(report.to_owned())));
    }
    Ok(results)
}

/// Returns the task, method and seed of a run that may be invalid.
fn title(run: &serde_json::Value) -> String {
    let parts = ["task", "method", "seed"].map(|key| run[key].to_string());
    parts.join(" · ").replace('"', "")
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_motion, fixture_results};
    use super::super::tables::tables;
    use super::*;

    /// Two finished runs, of which one has a motion, and an unfinished one without an evaluation.
    fn results() -> Results {
        let run = |task, seed, rows: &[f64], ended| FixtureRun {
            task,
            method: "TD3",
            seed,
            rows: rows.to_vec(),
            ended,
        };
        let mut results = fixture_results(&[
            run("reacher-v1", 1, &[-1.000_049, -0.1 - 0.2], true),
            run("panda-reach", 2, &[0.0, 1.0 / 3.0], true),
            run("panda-reach", 3, &[], false),
        ]);
        results.runs[0].motion = Some(fixture_motion(1.0 / 3.0, -2.0));
        results.not_started = vec![RunKey { seed: 9, ..results.runs[0].key() }];
        results.sweeps = vec![("paper".to_owned(), "seeds = [1]\n".to_owned())];
        results
    }

    fn folder_with(text: &[u8]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(FILE), text).unwrap();
        folder
    }

    #[test]
    fn numbers_survive_writing_and_reading_exactly() {
        let results = results();
        let text = encode(&results).unwrap();
        assert_eq!(text.iter().filter(|byte| **byte == b'\n').count(), 5, "one line per run");
        let folder = folder_with(&text);
        let earlier = read(&folder.path().join(FILE)).unwrap();
        assert_eq!(String::from_utf8(encode(&earlier).unwrap()), String::from_utf8(text));
        let json = |results| serde_json::to_string(&tables(results)).unwrap();
        assert_eq!(json(&earlier), json(&results));
        let [ours, theirs] = [&results, &earlier].map(|results| {
            let runs = results.runs.iter();
            runs.map(|run| (run.key(), run.motion.clone(), run.last().is_some()))
                .collect::<Vec<_>>()
        });
        assert_eq!(ours, theirs);
        assert!(earlier.runs.iter().all(|run| run.directory().is_none()));
    }

    #[test]
    fn file_with_the_old_format_and_name_is_read() {
        let text = String::from_utf8(encode(&results()).unwrap()).unwrap();
        let older = text
            .replace("\"format_version\":3", "\"format_version\":2")
            .replace("\"final_episodes\":100,", "")
            .replace(",\"packages\":[\"Python 3.11.7\"],\"config_sha256\":null", "");
        assert!(!older.contains("packages") && !older.contains("final_episodes"), "{older}");
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(OLD_FILE), older).unwrap();
        let earlier = read(&find(folder.path()).unwrap()).unwrap();
        assert_eq!(earlier.runs.len(), 3);
        assert!(earlier.runs.iter().all(|run| run.final_episodes.is_none()));
    }

    #[test]
    fn only_drawn_rollouts_are_kept() {
        let mut results = results();
        let mut second = results.runs[0].clone();
        second.seed = 2;
        results.runs.push(second);
        let folder = folder_with(&encode(&results).unwrap());
        let earlier = read(&folder.path().join(FILE)).unwrap();
        let motion = |index: usize| earlier.runs[index].motion.as_ref().unwrap();
        assert!(motion(0).rollout.is_some() && motion(3).rollout.is_none());
        assert_eq!(motion(3).sparc, Some(-2.0));
    }

    #[test]
    fn errors_name_the_file_and_the_run_or_the_format() {
        let text = String::from_utf8(encode(&results()).unwrap()).unwrap();
        let run = "run 1 (reacher-v1 · TD3 · 1)";
        for (from, to, expected) in [
            ("\"updates\":[1000,2000]", "\"updates\":[1000]", "updates has 1 evaluations"),
            ("\"updates\":[1000,2000]", "\"updates\":[1000,null]", "expected u64"),
            ("\"env_steps\":[1000,2000]", "\"env_steps\":[2000,1000]", "env_steps decreases"),
            (",[4.0]]", "]", "3 rows of positions and 2 of velocities"),
            (",[0.3]]", ",[0.3,0.3]]", "rows whose length differs from its 1 joints"),
            ("\"policy\":\"mlp\"", "\"policy\":\"table\"", "unknown variant"),
        ] {
            assert!(text.contains(from), "{from}");
            let folder = folder_with(text.replacen(from, to, 1).as_bytes());
            let error = format!("{:#}", read(&folder.path().join(FILE)).unwrap_err());
            for part in [FILE, run, expected] {
                assert!(error.contains(part), "{part} is not in: {error}");
            }
        }
        for (from, to, expected) in [
            ("\"format_version\":3", "\"format_version\":1", "it contains only curves"),
            ("\"format_version\":3", "\"format_version\":4", "has format 4, expected 2 to 3"),
            ("\"format_version\":3", "\"version\":3", "is not the data of a report"),
            ("\"methods\":[\"TD3\"]", "\"methods\":[]", "not in the lists"),
            ("-1.000049", "1e999", "number out of range"),
        ] {
            let folder = folder_with(text.replacen(from, to, 1).as_bytes());
            let error = format!("{:#}", read(&folder.path().join(FILE)).unwrap_err());
            assert!(error.contains(FILE) && error.contains(expected), "{error}");
        }
        let ended = text.replacen("\"ended\":false", "\"ended\":true", 1);
        let folder = folder_with(ended.as_bytes());
        let error = format!("{:#}", read(&folder.path().join(FILE)).unwrap_err());
        assert!(error.contains("run 3") && error.contains("without an evaluation"), "{error}");
    }
}
