//! One run of a sweep: its directory and its process.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Instant;

use anyhow::Context;
use dmprl_run::format::shown;
use dmprl_run::sweep_files::{Ledger, PlannedRun, flatten};
use dmprl_run::{RunDirectory, replace_file};
use dmprl_run::{describe, last_lines};
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::supervision::EvaluationRow;
use rustix::process::{Pid, Signal, kill_process};
use tokio::process::{Child, Command};

/// Location and program of a sweep.
#[derive(Debug, Clone)]
pub struct Site {
    /// Program that trains: this one.
    pub program: PathBuf,
    /// Output directory of the sweep.
    pub output: PathBuf,
    /// The sweep file's text.
    pub text: String,
    /// Function that returns the environment steps of the newest checkpoint; 0 if there is none.
    pub checkpointed_steps: fn(&RunDirectory) -> anyhow::Result<u64>,
}

/// Progress of a run.
#[derive(Debug, Clone, PartialEq)]
pub enum RunState {
    /// Not started, or stopped.
    Open {
        /// Environment steps in its newest checkpoint.
        env_steps: u64,
    },
    /// Completed.
    Finished,
    /// It ended with an error.
    Failed {
        /// Reason, with the last lines of its log.
        reason: String,
    },
}

impl Site {
    /// Copies the sweep file into the output directory for the report. Called only after all runs
    /// there have been checked against it, because the report takes their names from the file.
    pub(super) fn keep_file(&self) -> anyhow::Result<()> {
        replace_file(&self.output.join("sweep.toml"), self.text.as_bytes())
    }

    /// Returns the progress of a run from the files in its directory.
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
        // The only key that may be changed later.
        found.run.steps = config.run.steps;
        check_same(&path, config, &found)?;
        if ledger.of(&run.directory).is_some_and(|done| done.is_whole(config.run.steps)) {
            return Ok(RunState::Finished);
        }
        Ok(RunState::Open { env_steps: (self.checkpointed_steps)(&directory)? })
    }

    /// Environment steps in the newest line of its metrics; 0 if the run cannot be read.
    pub(super) fn reached(&self, run: &PlannedRun) -> u64 {
        let directory = RunDirectory::open(&self.output.join(&run.directory));
        directory.and_then(|directory| directory.measured_steps()).ok().flatten().unwrap_or(0)
    }

    /// Evaluations of the run, oldest first; empty while its directory is incomplete.
    pub(super) fn evaluations(&self, run: &PlannedRun) -> anyhow::Result<Vec<EvaluationRow>> {
        let path = self.output.join(&run.directory);
        if is_whole(&path) { RunDirectory::open(&path)?.evaluations() } else { Ok(Vec::new()) }
    }

    /// Returns the training time in seconds and the last evaluation of a finished run.
    pub(super) fn ended(&self, run: &PlannedRun) -> anyhow::Result<(f64, Option<EvaluationRow>)> {
        let directory = RunDirectory::open(&self.output.join(&run.directory))?;
        Ok((directory.wall_s_before()?, directory.latest_row()?))
    }

    /// Describes the failure of a run's process, with the last lines of its log.
    pub(super) fn failure(&self, run: &PlannedRun, status: ExitStatus) -> String {
        let log = self.log_path(run);
        format!("{}; {}:\n{}", describe(status), shown(&log), last_lines(&log))
    }

    fn log_path(&self, run: &PlannedRun) -> PathBuf {
        let name: Vec<_> =
            run.directory.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        self.output.join("logs").join(format!("{}.log", name.join("-")))
    }

    /// Starts or resumes a run.
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

/// Prepares a child that ignores the terminal's signals and receives SIGTERM when this process
/// dies.
pub(super) fn guarded(mut command: std::process::Command) -> Command {
    // This process forwards interrupts; the terminal's would reach the child a second time.
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    let mut command = Command::from(command);
    // SAFETY: `prctl` is async-signal-safe, allocates nothing and touches no lock.
    unsafe {
        command.pre_exec(|| {
            // If the sweep is killed, its runs are interrupted and write a checkpoint.
            rustix::process::set_parent_process_death_signal(Some(Signal::TERM)).map_err(Into::into)
        });
    }
    command
}

/// The process of a run.
pub(super) struct RunProcess {
    pub(super) child: Child,
    started: Instant,
    /// Environment steps at its start.
    pub(super) env_steps: u64,
}

impl RunProcess {
    /// Returns the environment steps since its start and their duration in seconds. The start-up
    /// time is included, since another run will need it too.
    pub(super) fn measured(&self, reached: u64) -> (u64, f64) {
        (reached.saturating_sub(self.env_steps), self.started.elapsed().as_secs_f64())
    }

    /// Interrupts the run: the first time it writes a checkpoint and exits; the second time it
    /// exits at once.
    pub(super) fn interrupt(&self) {
        let id = self.child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
        // Fails if the process has exited meanwhile, which is fine.
        let _ = id.map(|id| kill_process(id, Signal::INT));
    }
}

/// Returns true if a run directory is complete: the manifest is written last.
fn is_whole(path: &Path) -> bool {
    path.join("manifest.json").is_file()
}

/// Rejects a run with another configuration: a table must not mix their results under one name.
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
    let found: BTreeMap<_, _> = flatten(&found).into_iter().collect();
    let differing = flatten(&expected).into_iter().find_map(|(key, value)| {
        let other = found.get(&key)?;
        (*other != value).then(|| format!("{key} is {other} there and {value} in the file"))
    });
    anyhow::bail!(
        "{} was made with another configuration: {}; remove it, or name another --output",
        shown(path),
        differing.unwrap_or_else(|| "a key is missing".to_owned())
    )
}

/// Renames a run directory whose creation was interrupted. Its content is kept.
fn set_aside(path: &Path) -> anyhow::Result<()> {
    let name = |number: u32| path.with_extension(format!("unfinished-{number}"));
    let free = (0..).map(name).find(|name| !name.exists());
    let aside = free.context("no name is free")?;
    std::fs::rename(path, &aside).with_context(|| format!("cannot rename {}", path.display()))
}

/// Opens a log for appending, so that it keeps the output of earlier starts.
pub(super) fn open_log(path: &Path) -> anyhow::Result<File> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot make {}", folder.display()))?;
    }
    let file = OpenOptions::new().append(true).create(true).open(path);
    file.with_context(|| format!("cannot open {}", path.display()))
}

/// Short description of an evaluation.
pub(super) fn result(row: &EvaluationRow) -> String {
    let success =
        row.success_rate.map(|rate| format!(", success {:.0} %", rate * 100.0)).unwrap_or_default();
    format!("return {:.2}{success}", row.return_mean)
}
