//! Reads the runs of a report from run directories, sweeps and earlier reports.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dmprl_run::RunDirectory;
use dmprl_run::failure::wrong_use;
use dmprl_run::method_label;
use dmprl_run::sweep_files::found;
use dmprl_run::sweep_files::{Ledger, Plan, SweepFile, flatten};
use dmprl_shared::config::ExperimentConfig;

use super::motion::read_motions;
use super::results::Results;
use super::run::{Origin, Run, RunKey, Source};
use super::snapshot;

/// The directory of a sweep, and its record of finished runs.
struct Sweep<'s> {
    directory: &'s Path,
    ledger: Ledger,
}

impl Results {
    /// Reads runs, sweeps and the folders of earlier reports.
    ///
    /// # Errors
    /// Wrong use: a path is none of these, or no run has an evaluation. A run cannot be read.
    pub fn read(paths: &[PathBuf]) -> anyhow::Result<Self> {
        let mut results = Self::default();
        for path in paths {
            if path.join("sweep.toml").is_file() {
                results.add_sweep(path)?;
            } else if let Some(file) = snapshot::find(path) {
                results.add_snapshot(&file)?;
            } else {
                results.add_run(path)?;
            }
        }
        results.remove_duplicates();
        if results.runs.iter().all(|run| run.rows.is_empty()) {
            return Err(wrong_use("no run has an evaluation yet: there is nothing to report"));
        }
        read_motions(&mut results)?;
        Ok(results)
    }

    fn add_sweep(&mut self, directory: &Path) -> anyhow::Result<()> {
        let (file, text) = SweepFile::read(&directory.join("sweep.toml"))?;
        let name = directory.file_name().map(|name| name.to_string_lossy().into_owned());
        self.sweeps.push((name.unwrap_or_default(), text));
        let sweep = Sweep { directory, ledger: Ledger::open(directory)? };
        if let Some(search) = &file.search {
            // Only the best trial is compared: a table cannot have a column for each of dozens.
            for found in found(&file, search, directory)? {
                let method = format!("{}, best trial", found.method);
                self.add_planned(&found.task, &method);
                for (run, seed) in found.runs.iter().zip(&file.seeds) {
                    let key = run_key(&found.task, &method, *seed, run)?;
                    self.add_sweep_run(&sweep, run, key)?;
                }
            }
            return Ok(());
        }
        for planned in Plan::new(&file)?.runs {
            let point = planned.point.iter().map(|value| format!(", {value}"));
            let method = format!("{}{}", planned.method, point.collect::<String>());
            self.add_planned(&planned.task, &method);
            let key = run_key(&planned.task, &method, planned.seed, &planned.directory)?;
            self.add_sweep_run(&sweep, &planned.directory, key)?;
        }
        Ok(())
    }

    /// Adds the row and the column of a planned run, so that tables show it even if it has not
    /// started.
    fn add_planned(&mut self, task: &str, method: &str) {
        add_new(&mut self.tasks, task);
        add_new(&mut self.methods, method);
    }

    /// Adds a run of a sweep.
    ///
    /// - `relative`: the run directory, relative to that of the sweep.
    fn add_sweep_run(
        &mut self,
        sweep: &Sweep<'_>,
        relative: &Path,
        key: RunKey,
    ) -> anyhow::Result<()> {
        let path = sweep.directory.join(relative);
        // The manifest is the last file written when a run directory is created.
        if !path.join("manifest.json").is_file() {
            self.not_started.push(key);
            return Ok(());
        }
        let directory = RunDirectory::open(&path)?;
        let config = directory.config()?;
        let mut run = run(&directory, &config, key.method)?;
        let finished = sweep.ledger.of(relative);
        run.ended |= finished.is_some_and(|finished| finished.is_whole(config.run.steps));
        self.runs.push(run);
        Ok(())
    }

    /// Adds the runs of an earlier report.
    fn add_snapshot(&mut self, file: &Path) -> anyhow::Result<()> {
        let earlier = snapshot::read(file)?;
        earlier.tasks.iter().for_each(|task| add_new(&mut self.tasks, task));
        earlier.methods.iter().for_each(|method| add_new(&mut self.methods, method));
        for sweep in earlier.sweeps {
            if !self.sweeps.contains(&sweep) {
                self.sweeps.push(sweep);
            }
        }
        self.runs.extend(earlier.runs);
        self.not_started.extend(earlier.not_started);
        Ok(())
    }

    /// Keeps one of several copies of a run. A finished copy is preferred to an unfinished one,
    /// then a run directory to an earlier report, then the first on the command line. Two
    /// directories are never copies of one run, nor are two runs of the same report.
    fn remove_duplicates(&mut self) {
        let rank = |index: usize, run: &Run| (!run.ended, run.directory().is_none(), index);
        let is_replaced = |(index, run): &(usize, &Run)| {
            self.runs.iter().enumerate().any(|(other_index, other)| {
                let is_copy = other.directory().is_none() || run.directory().is_none();
                is_copy
                    && other.source != run.source
                    && other.has_key(&run.key())
                    && rank(other_index, other) < rank(*index, run)
            })
        };
        let kept = self.runs.iter().enumerate().filter(|run| !is_replaced(run));
        self.runs = kept.map(|(_, run)| run.clone()).collect();
        let mut not_started: Vec<RunKey> = Vec::new();
        for key in std::mem::take(&mut self.not_started) {
            if !not_started.contains(&key) && !self.runs.iter().any(|run| run.has_key(&key)) {
                not_started.push(key);
            }
        }
        self.not_started = not_started;
    }

    /// Returns a label for a run that differs from those of other methods. If a run of the task has
    /// the same label and another learning configuration, it appends the first differing key.
    fn distinct_label(&self, label: String, config: &ExperimentConfig) -> anyhow::Result<String> {
        let own = learning_keys(config)?;
        let others = self.of(&config.task.name, &label).filter_map(Run::directory);
        for other in others {
            let others = learning_keys(&RunDirectory::open(other)?.config()?)?;
            if let Some((key, value)) =
                own.iter().find(|(key, value)| others.get(*key) != Some(value))
            {
                return Ok(format!("{label}, {key}={value}"));
            }
        }
        Ok(label)
    }

    fn add_run(&mut self, path: &Path) -> anyhow::Result<()> {
        let directory = RunDirectory::open(path)?;
        let config = directory.config()?;
        let manifest = directory.manifest()?;
        let label = self.distinct_label(method_label(&config, manifest.preset()), &config)?;
        let run = run(&directory, &config, label)?;
        add_new(&mut self.tasks, &run.task);
        add_new(&mut self.methods, &run.method);
        self.runs.push(run);
        Ok(())
    }
}

fn run_key(task: &str, method: &str, seed: i64, path: &Path) -> anyhow::Result<RunKey> {
    let seed = u64::try_from(seed).with_context(|| format!("seed of {}", path.display()))?;
    Ok(RunKey { task: task.to_owned(), method: method.to_owned(), seed })
}

/// Sections of the configuration that define a method. Runs that differ only in other sections
/// count as seeds of the same method.
const LEARNING_SECTIONS: [&str; 7] =
    ["policy", "dmp", "algorithm", "exploration", "replay", "demonstrations", "pacing"];

/// Returns every key of the sections that define a method, with its value.
fn learning_keys(config: &ExperimentConfig) -> anyhow::Result<BTreeMap<String, toml::Value>> {
    let mut table = toml::Table::try_from(config).context("cannot compare configurations")?;
    table.retain(|section, _| LEARNING_SECTIONS.contains(&section));
    Ok(flatten(&table).into_iter().collect())
}

fn add_new(names: &mut Vec<String>, name: &str) {
    if names.iter().all(|known| known != name) {
        names.push(name.to_owned());
    }
}

fn run(directory: &RunDirectory, config: &ExperimentConfig, method: String) -> anyhow::Result<Run> {
    let path = directory.path().to_owned();
    let rows = directory.evaluations().with_context(|| format!("run {}", path.display()))?;
    let ended = rows.last().is_some_and(|row| {
        row.env_steps >= config.run.steps
            || row.return_mean >= config.run.until_return
            || row.success_rate.is_some_and(|rate| rate >= config.run.until_success)
    });
    let (task, seed, steps) = (config.task.name.clone(), config.run.seed, config.run.steps);
    let origin = Origin::of(&directory.manifest()?);
    let (policy, source) = (config.policy.kind, Source::Directory(path));
    let final_episodes = rows.last().map(|row| row.returns.len() as u64);
    Ok(Run {
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
        motion: None,
    })
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_results};
    use super::*;

    /// Removes duplicates; returns seed and return of the remaining runs.
    ///
    /// - `runs`: seed, whether it has a directory, whether it is finished, and return of each.
    fn kept(runs: &[(u64, bool, bool, f64)]) -> Vec<(u64, f64)> {
        let run = |(seed, _, ended, value): &(u64, bool, bool, f64)| FixtureRun {
            task: "reacher-v1",
            method: "TD3",
            seed: *seed,
            rows: vec![*value],
            ended: *ended,
        };
        let mut results = fixture_results(&runs.iter().map(run).collect::<Vec<_>>());
        for (index, (run, (_, has_directory, ..))) in results.runs.iter_mut().zip(runs).enumerate()
        {
            if !has_directory {
                run.source = Source::Report(format!("report-{index}").into());
            }
        }
        let key = results.runs[0].key();
        results.not_started = [1, 8, 8].map(|seed| RunKey { seed, ..key.clone() }).to_vec();
        results.remove_duplicates();
        assert_eq!(results.not_started.iter().filter(|key| key.seed == 8).count(), 1);
        assert!(results.not_started.iter().all(|key| key.seed != 1), "it has started");
        results.runs.iter().map(|run| (run.seed, run.rows[0].return_mean)).collect()
    }

    #[test]
    fn finished_run_directory_is_preferred_to_an_earlier_report() {
        let (directory, report, ended, unfinished) = (true, false, true, false);
        let cases = [
            // The order of the arguments does not matter.
            (vec![(1, directory, ended, -1.0), (1, report, ended, -2.0)], vec![(1, -1.0)]),
            (vec![(1, report, ended, -2.0), (1, directory, ended, -1.0)], vec![(1, -1.0)]),
            (vec![(1, directory, unfinished, -1.0), (1, report, ended, -2.0)], vec![(1, -2.0)]),
            (
                vec![(1, report, unfinished, -2.0), (1, directory, unfinished, -1.0)],
                vec![(1, -1.0)],
            ),
            // Of two reports, the first in which the run is finished is kept.
            (vec![(1, report, ended, -1.0), (1, report, ended, -2.0)], vec![(1, -1.0)]),
            (vec![(1, report, unfinished, -1.0), (1, report, ended, -2.0)], vec![(1, -2.0)]),
            // Different seeds are different runs, and two directories are never copies of one run.
            (
                vec![(1, directory, ended, -1.0), (2, report, ended, -2.0)],
                vec![(1, -1.0), (2, -2.0)],
            ),
            (
                vec![(1, directory, ended, -1.0), (1, directory, ended, -2.0)],
                vec![(1, -1.0), (1, -2.0)],
            ),
        ];
        for (runs, expected) in cases {
            assert_eq!(kept(&runs), expected, "{runs:?}");
        }
    }
}
