//! Runs what a plan asks for, so many at once, until all is done or the user stops it.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_learner::checkpoint;
use dmprl_shared::config::ExperimentConfig;
use rustix::process::{Pid, Signal, kill_process};
use tokio::process::{Child, Command};
use tokio::sync::mpsc;

use super::estimate::Estimate;
use super::{Finished, Ledger, PlannedRun};
use crate::control::EvaluationRow;
use crate::launch::{describe, interrupts, last_lines};
use crate::run_directory::RunDirectory;
use crate::terminal::{SweepProgress, shown};

/// Between two looks at how far the running ones are.
const LOOK: Duration = Duration::from_secs(2);
/// Between two looks whether a child has ended.
const END_LOOK: Duration = Duration::from_millis(100);

/// What to do.
pub struct Sweep {
    /// The program that trains: this one.
    pub program: PathBuf,
    /// Where everything goes.
    pub output: PathBuf,
    /// The runs, each with the configuration that it is to have.
    pub runs: Vec<(PlannedRun, ExperimentConfig)>,
    /// Runs at once.
    pub jobs: usize,
    /// How far the run in a directory may have come.
    pub ledger: Ledger,
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

/// How a sweep ended.
#[derive(Debug)]
pub struct SweepReport {
    /// Of each run, in the plan's order.
    pub states: Vec<RunState>,
    /// Whether the user stopped it.
    pub interrupted: bool,
}

/// How far each run of a plan is, by what lies in the sweep's directory.
///
/// # Errors
/// A run directory is of another configuration, or cannot be read.
pub fn states(sweep: &Sweep) -> anyhow::Result<Vec<RunState>> {
    sweep.runs.iter().map(|(run, config)| state(sweep, run, config)).collect()
}

fn state(sweep: &Sweep, run: &PlannedRun, config: &ExperimentConfig) -> anyhow::Result<RunState> {
    let path = sweep.output.join(&run.directory);
    if !is_whole(&path) {
        return Ok(RunState::Open { env_steps: 0 });
    }
    let directory = RunDirectory::open(&path)?;
    let mut found = directory.config()?;
    // The one thing that may be asked for later.
    found.run.steps = config.run.steps;
    check_same(&path, config, &found)?;
    if sweep.ledger.of(&run.directory).is_some_and(|done| done.steps >= config.run.steps) {
        return Ok(RunState::Finished);
    }
    let counters = checkpoint::counters(&directory.checkpoints_path())?;
    let env_steps = counters.iter().map(|counters| counters.env_steps).max().unwrap_or(0);
    Ok(RunState::Open { env_steps })
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

/// Does what is open.
///
/// # Errors
/// A run directory is of another configuration, or the ledger cannot be written. A run that fails
/// is no error of the sweep's: it goes on with the others.
pub fn sweep(sweep: &mut Sweep) -> anyhow::Result<SweepReport> {
    let states = states(sweep)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the sweep's runtime")?;
    runtime.block_on(async {
        let interrupts = interrupts()?;
        Runner::new(sweep, states).run(interrupts).await
    })
}

/// A run's process.
struct Job {
    index: usize,
    child: Child,
    started: Instant,
    /// Where it began.
    env_steps: u64,
}

struct Runner<'a> {
    sweep: &'a mut Sweep,
    states: Vec<RunState>,
    /// Those to be started, the next last.
    waiting: Vec<usize>,
    jobs: Vec<Job>,
    estimate: Estimate,
    progress: SweepProgress,
    interrupts: u32,
}

impl<'a> Runner<'a> {
    fn new(sweep: &'a mut Sweep, states: Vec<RunState>) -> Self {
        let open = |index: &usize| states[*index] != RunState::Finished;
        let waiting: Vec<usize> = (0..states.len()).rev().filter(open).collect();
        let mut estimate = Estimate::default();
        for (run, _) in &sweep.runs {
            if let Some(done) = sweep.ledger.of(&run.directory) {
                estimate.add(kind(run), done.env_steps, done.wall_s);
            }
        }
        let progress = SweepProgress::new(states.len(), states.len() - waiting.len());
        Self { sweep, states, waiting, jobs: Vec::new(), estimate, progress, interrupts: 0 }
    }

    async fn run(mut self, mut interrupts: mpsc::Receiver<()>) -> anyhow::Result<SweepReport> {
        let mut look = tokio::time::interval(LOOK);
        let mut end_look = tokio::time::interval(END_LOOK);
        loop {
            while self.interrupts == 0 && self.jobs.len() < self.sweep.jobs {
                let Some(index) = self.waiting.pop() else { break };
                self.start(index);
            }
            if self.jobs.is_empty() {
                break;
            }
            tokio::select! {
                Some(()) = interrupts.recv() => self.on_interrupt(),
                _ = end_look.tick() => self.on_ends()?,
                _ = look.tick() => self.progress.remaining(self.remaining()),
            }
        }
        self.progress.close();
        Ok(SweepReport { states: self.states, interrupted: self.interrupts > 0 })
    }

    /// Each interrupt goes on to the runs: once, they write a checkpoint; twice, they end at once.
    fn on_interrupt(&mut self) {
        self.interrupts += 1;
        if self.interrupts == 1 {
            self.progress.message("interrupted: the runs write a checkpoint (once more: at once)");
        }
        for job in &self.jobs {
            let id = job.child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
            // One that has ended meanwhile needs none.
            let _ = id.map(|id| kill_process(id, Signal::INT));
        }
    }

    fn start(&mut self, index: usize) {
        let (run, _) = &self.sweep.runs[index];
        let env_steps = match self.states[index] {
            RunState::Open { env_steps } => env_steps,
            _ => 0,
        };
        self.progress.message(&format!("{}: begins", run.title()));
        match self.command(index).and_then(|mut command| Ok(command.spawn()?)) {
            Ok(child) => {
                self.jobs.push(Job { index, child, started: Instant::now(), env_steps });
            }
            Err(error) => self.fail(index, format!("{error:#}")),
        }
    }

    fn log_path(&self, run: &PlannedRun) -> PathBuf {
        let name: Vec<_> =
            run.directory.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        self.sweep.output.join("logs").join(format!("{}.log", name.join("-")))
    }

    fn command(&self, index: usize) -> anyhow::Result<Command> {
        let (run, config) = &self.sweep.runs[index];
        let path = self.sweep.output.join(&run.directory);
        let mut command = std::process::Command::new(&self.sweep.program);
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
        // Our own interrupts go on to it; the terminal's would reach it a second time.
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut command = Command::from(command);
        // SAFETY: `prctl` is async-signal-safe, allocates nothing and touches no lock.
        unsafe {
            command.pre_exec(|| {
                // A sweep that is killed interrupts its runs: they write a checkpoint.
                rustix::process::set_parent_process_death_signal(Some(Signal::TERM))
                    .map_err(Into::into)
            });
        }
        Ok(command)
    }

    fn on_ends(&mut self) -> anyhow::Result<()> {
        let mut place = 0;
        while place < self.jobs.len() {
            match self.jobs[place].child.try_wait() {
                Ok(None) => place += 1,
                Ok(Some(status)) => {
                    let job = self.jobs.swap_remove(place);
                    self.on_end(&job, status)?;
                }
                Err(error) => {
                    let job = self.jobs.swap_remove(place);
                    self.fail(job.index, format!("cannot wait for it: {error}"));
                }
            }
        }
        Ok(())
    }

    fn on_end(&mut self, job: &Job, status: ExitStatus) -> anyhow::Result<()> {
        let (run, config) = self.sweep.runs[job.index].clone();
        let path = self.sweep.output.join(&run.directory);
        if !status.success() {
            if self.interrupts > 0 {
                // It has come further, if it wrote its checkpoint.
                if let Ok(state) = state(self.sweep, &run, &config) {
                    self.states[job.index] = state;
                }
                return Ok(());
            }
            let log = self.log_path(&run);
            let reason = format!("{}; {}:\n{}", describe(status), shown(&log), last_lines(&log));
            self.fail(job.index, reason);
            return Ok(());
        }
        let (wall_s, row) = match ended(&path) {
            Ok(ended) => ended,
            Err(error) => {
                self.fail(job.index, format!("its results cannot be read: {error:#}"));
                return Ok(());
            }
        };
        let steps = config.run.steps;
        let env_steps = row.as_ref().map_or(steps, |row| row.env_steps);
        let finished = Finished { run: run.directory.clone(), steps, env_steps, wall_s };
        self.sweep.ledger.add(finished)?;
        self.estimate.add(kind(&run), env_steps, wall_s);
        self.states[job.index] = RunState::Finished;
        let result = row.map_or_else(|| "no evaluation".to_owned(), |row| result(&row));
        self.progress.message(&format!("{}: {result} after {wall_s:.0} s", run.title()));
        let remaining = self.remaining();
        self.progress.ended(remaining);
        Ok(())
    }

    fn fail(&mut self, index: usize, reason: String) {
        let title = self.sweep.runs[index].0.title();
        self.progress.message(&format!("{title}: failed, {reason}"));
        self.states[index] = RunState::Failed { reason };
        let remaining = self.remaining();
        self.progress.ended(remaining);
    }

    /// How long the rest will take.
    fn remaining(&self) -> Option<Duration> {
        let mut estimate = self.estimate.clone();
        let mut left = Vec::new();
        for job in &self.jobs {
            let (run, config) = &self.sweep.runs[job.index];
            let reached = self.reached(run).max(job.env_steps);
            let seconds = job.started.elapsed().as_secs_f64();
            estimate.add(kind(run), reached - job.env_steps, seconds);
            left.push((kind(run), config.run.steps.saturating_sub(reached)));
        }
        for &index in &self.waiting {
            let (run, config) = &self.sweep.runs[index];
            let RunState::Open { env_steps } = self.states[index] else { continue };
            left.push((kind(run), config.run.steps.saturating_sub(env_steps)));
        }
        estimate.remaining(left, self.sweep.jobs)
    }

    /// Environment steps by the newest line of its metrics; a run that cannot be read has none.
    fn reached(&self, run: &PlannedRun) -> u64 {
        let directory = RunDirectory::open(&self.sweep.output.join(&run.directory));
        directory.and_then(|directory| directory.measured_steps()).ok().flatten().unwrap_or(0)
    }
}

fn kind(run: &PlannedRun) -> (&str, &str) {
    (&run.task, &run.method)
}

/// Seconds of training and the last evaluation of a run that has ended.
fn ended(path: &Path) -> anyhow::Result<(f64, Option<EvaluationRow>)> {
    let directory = RunDirectory::open(path)?;
    Ok((directory.wall_s_before()?, directory.latest_row()?))
}

/// A directory whose making was cut short is nobody's run; what is in it stays, under another name.
fn set_aside(path: &Path) -> anyhow::Result<()> {
    let name = |number: u32| path.with_extension(format!("unfinished-{number}"));
    let free = (0..).map(name).find(|name| !name.exists());
    let aside = free.context("no name is free")?;
    std::fs::rename(path, &aside).with_context(|| format!("cannot rename {}", path.display()))
}

fn open_log(path: &Path) -> anyhow::Result<File> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot make {}", folder.display()))?;
    }
    let file = OpenOptions::new().append(true).create(true).open(path);
    file.with_context(|| format!("cannot open {}", path.display()))
}

fn result(row: &EvaluationRow) -> String {
    let success =
        row.success_rate.map(|rate| format!(", success {:.0} %", rate * 100.0)).unwrap_or_default();
    format!("return {:.2}{success}", row.return_mean)
}
