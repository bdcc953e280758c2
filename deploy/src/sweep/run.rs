//! One run of a sweep: its directory, and the process that trains it.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Instant;

use anyhow::Context;
use dmprl_learner::checkpoint;
use dmprl_shared::config::ExperimentConfig;
use rustix::process::{Pid, Signal, kill_process};
use tokio::process::{Child, Command};

use super::{Ledger, PlannedRun};
use crate::control::EvaluationRow;
use crate::launch::{describe, last_lines};
use crate::run_directory::{RunDirectory, replace_file};
use crate::terminal::shown;

/// Where a sweep is made, and by what.
#[derive(Debug, Clone)]
pub struct Site {
    /// The program that trains: this one.
    pub program: PathBuf,
    /// Where everything goes.
    pub output: PathBuf,
    /// The sweep file's text.
    pub text: String,
}

/// How far a run is.
#[derive(Debug, Clone, PartialEq)]
pub enum RunState {
    /// Not begun, or stopped at so many environment steps.
    Open {
        /// In its newest checkpoint.
        env_steps: u64,
    },
    /// At its end.
    Finished,
    /// It ended with an error.
    Failed {
        /// Why, with the last lines of its log.
        reason: String,
    },
}

impl Site {
    /// Leaves the sweep's file for the report: what was asked for last. Only once all that lies
    /// here is known to be of it, since the report calls the runs what the file calls them.
    pub(super) fn keep_file(&self) -> anyhow::Result<()> {
        replace_file(&self.output.join("sweep.toml"), self.text.as_bytes())
    }

    /// How far a run is, by what lies in its directory.
    pub(super) fn state(
        &self,
        ledger: &Ledger,
        run: &PlannedRun,
        config: &ExperimentConfig,
    ) -> anyhow::Result<RunState> {
        let path = self.output.join(&run.directory);
        if !is_whole(&path) {
            return Ok(RunState::Open { env_steps: 0 });
        }
        let directory = RunDirectory::open(&path)?;
        let mut found = directory.config()?;
        // The one thing that may be asked for later.
        found.run.steps = config.run.steps;
        check_same(&path, config, &found)?;
        if ledger.of(&run.directory).is_some_and(|done| done.is_whole(config.run.steps)) {
            return Ok(RunState::Finished);
        }
        let counters = checkpoint::counters(&directory.checkpoints_path())?;
        let env_steps = counters.iter().map(|counters| counters.env_steps).max().unwrap_or(0);
        Ok(RunState::Open { env_steps })
    }

    /// Environment steps by the newest line of its metrics; a run that cannot be read has none.
    pub(super) fn reached(&self, run: &PlannedRun) -> u64 {
        let directory = RunDirectory::open(&self.output.join(&run.directory));
        directory.and_then(|directory| directory.measured_steps()).ok().flatten().unwrap_or(0)
    }

    /// Its evaluations, oldest first; none before its directory is whole.
    pub(super) fn evaluations(&self, run: &PlannedRun) -> anyhow::Result<Vec<EvaluationRow>> {
        let path = self.output.join(&run.directory);
        if is_whole(&path) { RunDirectory::open(&path)?.evaluations() } else { Ok(Vec::new()) }
    }

    /// Seconds of training and the last evaluation of a run that has ended.
    pub(super) fn ended(&self, run: &PlannedRun) -> anyhow::Result<(f64, Option<EvaluationRow>)> {
        let directory = RunDirectory::open(&self.output.join(&run.directory))?;
        Ok((directory.wall_s_before()?, directory.latest_row()?))
    }

    /// Why a run's process failed, with the last lines of its log.
    pub(super) fn failure(&self, run: &PlannedRun, status: ExitStatus) -> String {
        let log = self.log_path(run);
        format!("{}; {}:\n{}", describe(status), shown(&log), last_lines(&log))
    }

    fn log_path(&self, run: &PlannedRun) -> PathBuf {
        let name: Vec<_> =
            run.directory.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        self.output.join("logs").join(format!("{}.log", name.join("-")))
    }

    /// Begins a run, or goes on with it.
    pub(super) fn start(
        &self,
        run: &PlannedRun,
        config: &ExperimentConfig,
        env_steps: u64,
    ) -> anyhow::Result<RunProcess> {
        let path = self.output.join(&run.directory);
        let mut command = std::process::Command::new(&self.program);
        if !is_whole(&path) && path.exists() {
            set_aside(&path)?;
        }
        if is_whole(&path) {
            command.arg("resume").arg(&path).args(["--steps", &config.run.steps.to_string()]);
        } else {
            command.arg("train").args(&run.arguments).arg("--run-dir").arg(&path);
        }
        command.arg("--no-progress").stdin(Stdio::null()).stdout(Stdio::null());
        command.stderr(open_log(&self.log_path(run))?);
        let child = guarded(command).spawn()?;
        Ok(RunProcess { child, started: Instant::now(), env_steps })
    }
}

/// A child that gets no signals of the terminal's, and an interrupt when this process dies.
pub(super) fn guarded(mut command: std::process::Command) -> Command {
    // Our own interrupts go on to it; the terminal's would reach it a second time.
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    let mut command = Command::from(command);
    // SAFETY: `prctl` is async-signal-safe, allocates nothing and touches no lock.
    unsafe {
        command.pre_exec(|| {
            // A sweep that is killed interrupts its runs: they write a checkpoint.
            rustix::process::set_parent_process_death_signal(Some(Signal::TERM)).map_err(Into::into)
        });
    }
    command
}

/// A run's process.
pub(super) struct RunProcess {
    pub(super) child: Child,
    started: Instant,
    /// Where it began.
    pub(super) env_steps: u64,
}

impl RunProcess {
    /// Environment steps since its start and the seconds that they took, start-up and all: what
    /// another run will take too.
    pub(super) fn measured(&self, reached: u64) -> (u64, f64) {
        (reached.saturating_sub(self.env_steps), self.started.elapsed().as_secs_f64())
    }

    /// Once: it writes a checkpoint and ends; twice: it ends at once.
    pub(super) fn interrupt(&self) {
        let id = self.child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
        // One that has ended meanwhile needs none.
        let _ = id.map(|id| kill_process(id, Signal::INT));
    }
}

/// Whether a run directory was made to its end: the manifest comes last.
fn is_whole(path: &Path) -> bool {
    path.join("manifest.json").is_file()
}

/// Results of two configurations must not stand in one table under one name.
fn check_same(
    path: &Path,
    expected: &ExperimentConfig,
    found: &ExperimentConfig,
) -> anyhow::Result<()> {
    if expected == found {
        return Ok(());
    }
    let tables = [expected, found].map(toml::Table::try_from);
    let [expected, found] = tables.map(|table| table.unwrap_or_default());
    let found: BTreeMap<_, _> = super::file::flatten(&found).into_iter().collect();
    let differing = super::file::flatten(&expected).into_iter().find_map(|(key, value)| {
        let other = found.get(&key)?;
        (*other != value).then(|| format!("{key} is {other} there and {value} in the file"))
    });
    anyhow::bail!(
        "{} was made with another configuration: {}; remove it, or name another --output",
        shown(path),
        differing.unwrap_or_else(|| "a key is missing".to_owned())
    )
}

/// A directory whose making was cut short is nobody's run; what is in it stays, under another name.
fn set_aside(path: &Path) -> anyhow::Result<()> {
    let name = |number: u32| path.with_extension(format!("unfinished-{number}"));
    let free = (0..).map(name).find(|name| !name.exists());
    let aside = free.context("no name is free")?;
    std::fs::rename(path, &aside).with_context(|| format!("cannot rename {}", path.display()))
}

/// A log that outlives this start.
pub(super) fn open_log(path: &Path) -> anyhow::Result<File> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot make {}", folder.display()))?;
    }
    let file = OpenOptions::new().append(true).create(true).open(path);
    file.with_context(|| format!("cannot open {}", path.display()))
}

/// An evaluation in a few words.
pub(super) fn result(row: &EvaluationRow) -> String {
    let success =
        row.success_rate.map(|rate| format!(", success {:.0} %", rate * 100.0)).unwrap_or_default();
    format!("return {:.2}{success}", row.return_mean)
}
