//! The runs that a report is made of.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dmprl_shared::config::{AlgorithmName, ExperimentConfig, PRESETS, PolicyKind};

use crate::control::EvaluationRow;
use crate::failure::wrong_use;
use crate::motion::Motion;
use crate::run_directory::{Machine, Manifest, RunDirectory, Session};
use crate::sweep::search::found;
use crate::sweep::{Ledger, Plan, SweepFile, flatten};
use crate::terminal::binary_bytes;

/// Of a commit's hash, enough to find it.
const HASH_LEN: usize = 12;

/// One run and its evaluations.
#[derive(Debug, Clone)]
pub struct Run {
    /// The task's name.
    pub task: String,
    /// The method's label.
    pub method: String,
    /// What its method plans with.
    pub policy: PolicyKind,
    /// `run.seed`.
    pub seed: u64,
    /// Its directory.
    pub path: PathBuf,
    /// Whether it has come to its end.
    pub ended: bool,
    /// Environment steps that it was asked for.
    pub steps: u64,
    /// Who made it, where and when.
    pub origin: Origin,
    /// Oldest first.
    pub rows: Vec<EvaluationRow>,
    /// How its last policy moves, where that was measured.
    pub motion: Option<Motion>,
}

/// Who made a run, where and when.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Origin {
    /// UTC, RFC 3339, of its first session.
    pub started: String,
    /// Versions of the program, with the commit where it is known; one a session.
    pub programs: Vec<String>,
    /// Processor, cores and memory.
    pub machine: String,
}

impl Origin {
    fn of(manifest: &Manifest) -> Self {
        let program = |session: &Session| match &session.git_commit {
            Some(commit) => {
                let (hash, dirty) = commit.split_once('-').unwrap_or((commit, ""));
                let hash: String = hash.chars().take(HASH_LEN).collect();
                let dirty = if dirty.is_empty() { "" } else { ", changed since" };
                format!("{} (commit {hash}{dirty})", session.dmprl_version)
            }
            None => session.dmprl_version.clone(),
        };
        let Machine { os, cpu, cores, memory_bytes } = &manifest.machine;
        let cpu = cpu.as_deref().unwrap_or("unknown processor");
        let memory = memory_bytes.map(|bytes| format!(", {}", binary_bytes(bytes)));
        Self {
            started: manifest
                .sessions
                .first()
                .map(|first| first.started.clone())
                .unwrap_or_default(),
            programs: manifest.sessions.iter().map(program).collect(),
            machine: format!("{cpu}, {cores} cores{}, {os}", memory.unwrap_or_default()),
        }
    }
}

impl Run {
    /// The evaluation at its end; none while it has not come there.
    #[must_use]
    pub fn last(&self) -> Option<&EvaluationRow> {
        self.rows.last().filter(|_| self.ended)
    }
}

/// All runs of a report; tasks and methods in the order in which they were named.
#[derive(Debug, Clone, Default)]
pub struct Results {
    /// Rows of the tables.
    pub tasks: Vec<String>,
    /// Their columns.
    pub methods: Vec<String>,
    /// Those that have begun.
    pub runs: Vec<Run>,
    /// How many there are to be.
    pub planned: usize,
    /// The files of the sweeps, by the names of their directories.
    pub sweeps: Vec<(String, String)>,
    /// Runs whose motion could not be measured, and why.
    pub unmeasured: Vec<String>,
    /// Runs that could not be drawn, and why.
    pub undrawn: Vec<String>,
}

impl Results {
    /// Reads runs and sweeps.
    ///
    /// # Errors
    /// Wrong use: a path is neither, or nothing has begun. A run that cannot be read.
    pub fn read(paths: &[PathBuf]) -> anyhow::Result<Self> {
        let mut results = Self::default();
        for path in paths {
            if path.join("sweep.toml").is_file() {
                results.add_sweep(path)?;
            } else {
                results.add_run(path)?;
            }
        }
        if results.runs.iter().all(|run| run.rows.is_empty()) {
            return Err(wrong_use("no run has an evaluation yet: there is nothing to report"));
        }
        super::motion::read_motions(&mut results)?;
        Ok(results)
    }

    /// The runs of one task by one method.
    pub fn of<'a>(&'a self, task: &'a str, method: &'a str) -> impl Iterator<Item = &'a Run> {
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
                for run in &found.runs {
                    self.planned += 1;
                    self.add_begun(sweep, &ledger, run, &method)?;
                }
            }
            return Ok(());
        }
        for planned in Plan::new(&file)?.runs {
            let point = planned.point.iter().map(|value| format!(", {value}"));
            let method = format!("{}{}", planned.method, point.collect::<String>());
            self.planned += 1;
            self.add_planned(&planned.task, &method);
            self.add_begun(sweep, &ledger, &planned.directory, &method)?;
        }
        Ok(())
    }

    /// A cell that was not run stands in the tables too.
    fn add_planned(&mut self, task: &str, method: &str) {
        add_new(&mut self.tasks, task);
        add_new(&mut self.methods, method);
    }

    /// A run of a sweep, if it has begun.
    fn add_begun(
        &mut self,
        sweep: &Path,
        ledger: &Ledger,
        place: &Path,
        method: &str,
    ) -> anyhow::Result<()> {
        let path = sweep.join(place);
        // The manifest is the last that is written when a directory is made.
        if path.join("manifest.json").is_file() {
            let directory = RunDirectory::open(&path)?;
            let config = directory.config()?;
            let mut run = run(&directory, &config, method.to_owned())?;
            let finished = ledger.of(place);
            run.ended |= finished.is_some_and(|finished| finished.is_whole(config.run.steps));
            self.runs.push(run);
        }
        Ok(())
    }

    /// The label, with the first value that differs where another run of the task has it and learns
    /// otherwise: whatever they were begun with, they are no seeds of one method.
    fn own_label(&self, label: String, config: &ExperimentConfig) -> anyhow::Result<String> {
        let own = learning(config)?;
        for other in self.of(&config.task.name, &label) {
            let others = learning(&RunDirectory::open(&other.path)?.config()?)?;
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
        self.planned += 1;
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
    let policy = config.policy.kind;
    Ok(Run { task, method, policy, seed, path, ended, steps, origin, rows, motion: None })
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
