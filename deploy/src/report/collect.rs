//! The runs that a report is made of.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dmprl_shared::config::{AlgorithmName, ExperimentConfig, PRESETS, PolicyKind};

use super::landed;
use super::run::{Key, Origin, Run, Source};
use crate::failure::wrong_use;
use crate::run_directory::RunDirectory;
use crate::sweep::search::found;
use crate::sweep::{Ledger, Plan, SweepFile, flatten};

/// All runs of a report; tasks and methods in the order in which they were named.
#[derive(Debug, Clone, Default)]
pub struct Results {
    /// Rows of the tables.
    pub tasks: Vec<String>,
    /// Their columns.
    pub methods: Vec<String>,
    /// Those that have begun.
    pub runs: Vec<Run>,
    /// Those that are to be.
    pub waiting: Vec<Key>,
    /// The files of the sweeps, by the names of their directories.
    pub sweeps: Vec<(String, String)>,
    /// Runs whose motion could not be measured, and why.
    pub unmeasured: Vec<String>,
    /// Runs that could not be drawn, and why.
    pub undrawn: Vec<String>,
}

impl Results {
    /// Reads runs, sweeps and the folders of earlier reports.
    ///
    /// # Errors
    /// Wrong use: a path is none of these, or nothing has begun. A run that cannot be read.
    pub fn read(paths: &[PathBuf]) -> anyhow::Result<Self> {
        let mut results = Self::default();
        for path in paths {
            if path.join("sweep.toml").is_file() {
                results.add_sweep(path)?;
            } else if path.join(landed::FILE).is_file() {
                results.add_landed(path)?;
            } else {
                results.add_run(path)?;
            }
        }
        results.settle();
        if results.runs.iter().all(|run| run.rows.is_empty()) {
            return Err(wrong_use("no run has an evaluation yet: there is nothing to report"));
        }
        super::motion::read_motions(&mut results)?;
        Ok(results)
    }

    /// The runs of one task by one method.
    pub fn of<'a>(
        &'a self,
        task: &'a str,
        method: &'a str,
    ) -> impl Iterator<Item = &'a Run> + Clone {
        self.runs.iter().filter(move |run| run.task == task && run.method == method)
    }

    fn add_sweep(&mut self, sweep: &Path) -> anyhow::Result<()> {
        let (file, text) = SweepFile::read(&sweep.join("sweep.toml"))?;
        let name = sweep.file_name().map(|name| name.to_string_lossy().into_owned());
        self.sweeps.push((name.unwrap_or_default(), text));
        let ledger = Ledger::open(sweep)?;
        if let Some(search) = &file.search {
            // What it found: dozens of trials side by side would be no comparison of methods.
            for found in found(&file, search, sweep)? {
                let method = format!("{}, best trial", found.method);
                self.add_planned(&found.task, &method);
                for (run, seed) in found.runs.iter().zip(&file.seeds) {
                    self.add_begun((sweep, &ledger), run, (&found.task, &method, *seed))?;
                }
            }
            return Ok(());
        }
        for planned in Plan::new(&file)?.runs {
            let point = planned.point.iter().map(|value| format!(", {value}"));
            let method = format!("{}{}", planned.method, point.collect::<String>());
            self.add_planned(&planned.task, &method);
            let which = (planned.task.as_str(), method.as_str(), planned.seed);
            self.add_begun((sweep, &ledger), &planned.directory, which)?;
        }
        Ok(())
    }

    /// A cell that was not run stands in the tables too.
    fn add_planned(&mut self, task: &str, method: &str) {
        add_new(&mut self.tasks, task);
        add_new(&mut self.methods, method);
    }

    /// A run of a sweep; one that has not begun waits.
    fn add_begun(
        &mut self,
        (sweep, ledger): (&Path, &Ledger),
        place: &Path,
        (task, method, seed): (&str, &str, i64),
    ) -> anyhow::Result<()> {
        let path = sweep.join(place);
        // The manifest is the last that is written when a directory is made.
        if !path.join("manifest.json").is_file() {
            let (task, method) = (task.to_owned(), method.to_owned());
            let seed =
                u64::try_from(seed).with_context(|| format!("seed of {}", path.display()))?;
            self.waiting.push(Key { task, method, seed });
            return Ok(());
        }
        let directory = RunDirectory::open(&path)?;
        let config = directory.config()?;
        let mut run = run(&directory, &config, method.to_owned())?;
        let finished = ledger.of(place);
        run.ended |= finished.is_some_and(|finished| finished.is_whole(config.run.steps));
        self.runs.push(run);
        Ok(())
    }

    /// What an earlier report knew.
    fn add_landed(&mut self, report: &Path) -> anyhow::Result<()> {
        let landed = landed::read(report)?;
        landed.tasks.iter().for_each(|task| add_new(&mut self.tasks, task));
        landed.methods.iter().for_each(|method| add_new(&mut self.methods, method));
        for sweep in landed.sweeps {
            if !self.sweeps.contains(&sweep) {
                self.sweeps.push(sweep);
            }
        }
        self.runs.extend(landed.runs);
        self.waiting.extend(landed.waiting);
        Ok(())
    }

    /// Of a run that was landed and lies here too, or was landed by two reports, one stays: before
    /// others one that has come to its end, then one in a directory, then the one named first.
    /// Runs of directories, or of one report, are never set against each other.
    fn settle(&mut self) {
        let rank = |index: usize, run: &Run| (!run.ended, run.directory().is_none(), index);
        let beaten = |(index, run): &(usize, &Run)| {
            self.runs.iter().enumerate().any(|(other_index, other)| {
                let landed = other.directory().is_none() || run.directory().is_none();
                landed
                    && other.source != run.source
                    && other.is(&run.key())
                    && rank(other_index, other) < rank(*index, run)
            })
        };
        let stay = self.runs.iter().enumerate().filter(|run| !beaten(run));
        self.runs = stay.map(|(_, run)| run.clone()).collect();
        let mut waiting: Vec<Key> = Vec::new();
        for key in std::mem::take(&mut self.waiting) {
            if !waiting.contains(&key) && !self.runs.iter().any(|run| run.is(&key)) {
                waiting.push(key);
            }
        }
        self.waiting = waiting;
    }

    /// The label, with the first value that differs where another run of the task has it and learns
    /// otherwise: whatever they were begun with, they are no seeds of one method.
    fn own_label(&self, label: String, config: &ExperimentConfig) -> anyhow::Result<String> {
        let own = learning(config)?;
        let others = self.of(&config.task.name, &label).filter_map(Run::directory);
        for other in others {
            let others = learning(&RunDirectory::open(other)?.config()?)?;
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
        let label = self.own_label(label(&config, manifest.preset()), &config)?;
        let run = run(&directory, &config, label)?;
        add_new(&mut self.tasks, &run.task);
        add_new(&mut self.methods, &run.method);
        self.runs.push(run);
        Ok(())
    }
}

/// What is learned, and how: runs that differ in nothing else are seeds of one method.
const LEARNING: [&str; 7] =
    ["policy", "dmp", "algorithm", "exploration", "replay", "demonstrations", "pacing"];

/// Every key that says what is learned and how, with its value.
fn learning(config: &ExperimentConfig) -> anyhow::Result<BTreeMap<String, toml::Value>> {
    let mut table = toml::Table::try_from(config).context("cannot compare configurations")?;
    table.retain(|section, _| LEARNING.contains(&section));
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

/// What a run is called that no sweep has named: a preset's runs are no seeds of the default's.
pub(crate) fn label(config: &ExperimentConfig, preset: Option<&str>) -> String {
    let method = method(config);
    match preset.filter(|&name| name != PRESETS[0].name) {
        Some(name) => format!("{method} ({name})"),
        None => method,
    }
}

fn method(config: &ExperimentConfig) -> String {
    let algorithm = match config.algorithm.name {
        AlgorithmName::Ddpg => "DDPG",
        AlgorithmName::Td3 => "TD3",
        AlgorithmName::Sac => "SAC",
        // It has no other policy.
        AlgorithmName::Ndp => return "NDP".to_owned(),
    };
    match config.policy.kind {
        PolicyKind::Dmp => format!("{algorithm}-DMP"),
        PolicyKind::Mlp => algorithm.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::planted::{Planted, planted};
    use super::*;

    /// Runs of one task and method: seed, whether it lies here, whether it has ended, its return.
    fn settled(runs: &[(u64, bool, bool, f64)]) -> Vec<(u64, f64)> {
        let run = |(seed, _, ended, value): &(u64, bool, bool, f64)| Planted {
            task: "reacher-v1",
            method: "TD3",
            seed: *seed,
            rows: vec![*value],
            ended: *ended,
        };
        let mut results = planted(&runs.iter().map(run).collect::<Vec<_>>());
        for (index, (run, (_, here, ..))) in results.runs.iter_mut().zip(runs).enumerate() {
            if !here {
                run.source = Source::Report(format!("report-{index}").into());
            }
        }
        results.waiting = [1, 8, 8].map(|seed| Key { seed, ..results.runs[0].key() }).to_vec();
        results.settle();
        assert_eq!(results.waiting.iter().filter(|key| key.seed == 8).count(), 1);
        assert!(results.waiting.iter().all(|key| key.seed != 1), "it has begun");
        results.runs.iter().map(|run| (run.seed, run.rows[0].return_mean)).collect()
    }

    #[test]
    fn a_landed_run_stands_where_none_that_lies_here_has_come_to_its_end() {
        let (here, landed, ended, begun) = (true, false, true, false);
        let cases = [
            // In whichever order they are named.
            (vec![(1, here, ended, -1.0), (1, landed, ended, -2.0)], vec![(1, -1.0)]),
            (vec![(1, landed, ended, -2.0), (1, here, ended, -1.0)], vec![(1, -1.0)]),
            (vec![(1, here, begun, -1.0), (1, landed, ended, -2.0)], vec![(1, -2.0)]),
            (vec![(1, landed, begun, -2.0), (1, here, begun, -1.0)], vec![(1, -1.0)]),
            // Two reports: the first that has its end.
            (vec![(1, landed, ended, -1.0), (1, landed, ended, -2.0)], vec![(1, -1.0)]),
            (vec![(1, landed, begun, -1.0), (1, landed, ended, -2.0)], vec![(1, -2.0)]),
            // Other seeds are other runs; two directories are never set against each other.
            (vec![(1, here, ended, -1.0), (2, landed, ended, -2.0)], vec![(1, -1.0), (2, -2.0)]),
            (vec![(1, here, ended, -1.0), (1, here, ended, -2.0)], vec![(1, -1.0), (1, -2.0)]),
        ];
        for (runs, expected) in cases {
            assert_eq!(settled(&runs), expected, "{runs:?}");
        }
    }
}
