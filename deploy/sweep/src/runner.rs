//! Trains the runs of a plan, several in parallel, until all have ended or the user interrupts.

use std::process::ExitStatus;
use std::time::Duration;

use anyhow::Context;
use dmprl_run::Progress;
use dmprl_run::sweep_files::{End, Finished, Ledger, PlannedRun};
use dmprl_shared::config::ExperimentConfig;
use dmprl_supervisor::interrupts;
use tokio::sync::mpsc;

use super::estimate::{Estimate, RunKind};
use super::run::{RunProcess, evaluation_text};
use super::{RunState, Site};
use crate::tally::Tally;

/// Interval between updates of the remaining time.
pub(super) const PROGRESS_INTERVAL: Duration = Duration::from_secs(2);
/// Interval between checks for exited children.
pub(super) const EXIT_POLL_INTERVAL: Duration = Duration::from_millis(100);

/// A sweep to run.
pub struct Sweep {
    /// Output directory and program.
    pub site: Site,
    /// Runs with their expected configurations.
    pub runs: Vec<(PlannedRun, ExperimentConfig)>,
    /// Number of parallel runs.
    pub jobs: usize,
    /// Finished runs in the output directory.
    pub ledger: Ledger,
}

/// Result of a sweep.
#[derive(Debug)]
pub struct SweepReport {
    /// State of each run, in the plan's order.
    pub states: Vec<RunState>,
    /// True if the user interrupted the sweep.
    pub interrupted: bool,
}

/// Returns the progress of each run of a plan from the files in the sweep's directory.
///
/// # Errors
/// A run directory has another configuration, or cannot be read.
pub fn states(sweep: &Sweep) -> anyhow::Result<Vec<RunState>> {
    let state = |(run, config): &_| sweep.site.state(&sweep.ledger, run, config);
    sweep.runs.iter().map(state).collect()
}

/// Trains all unfinished runs.
///
/// # Errors
/// A run directory has another configuration, or the ledger cannot be written. A failed run is not
/// an error: the sweep continues with the others.
pub fn sweep(sweep: &mut Sweep, progress: &dyn Progress) -> anyhow::Result<SweepReport> {
    let states = states(sweep)?;
    sweep.site.save_sweep_file()?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the sweep's runtime")?;
    runtime.block_on(async {
        let interrupts = interrupts()?;
        Runner::new(sweep, states, progress).run(interrupts).await
    })
}

/// A run in progress.
struct Job {
    index: usize,
    process: RunProcess,
}

struct Runner<'a> {
    sweep: &'a mut Sweep,
    states: Vec<RunState>,
    /// Runs that have not started, in reverse order.
    waiting: Vec<usize>,
    jobs: Vec<Job>,
    estimate: Estimate,
    progress: Tally<'a>,
    interrupts: u32,
}

impl<'a> Runner<'a> {
    fn new(sweep: &'a mut Sweep, states: Vec<RunState>, progress: &'a dyn Progress) -> Self {
        let open = |index: &usize| states[*index] != RunState::Finished;
        let waiting: Vec<usize> = (0..states.len()).rev().filter(open).collect();
        let mut estimate = Estimate::default();
        for (run, _) in &sweep.runs {
            if let Some(done) = sweep.ledger.of(&run.directory) {
                estimate.add(RunKind::of_run(run), done.env_steps, done.wall_s);
            }
        }
        let progress = Tally::new(progress, "runs", states.len(), states.len() - waiting.len());
        Self { sweep, states, waiting, jobs: Vec::new(), estimate, progress, interrupts: 0 }
    }

    async fn run(mut self, mut interrupts: mpsc::Receiver<()>) -> anyhow::Result<SweepReport> {
        let mut progress_tick = tokio::time::interval(PROGRESS_INTERVAL);
        let mut exit_poll = tokio::time::interval(EXIT_POLL_INTERVAL);
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
                _ = exit_poll.tick() => self.check_exits()?,
                _ = progress_tick.tick() => self.progress.remaining(self.remaining()),
            }
        }
        Ok(SweepReport { states: self.states, interrupted: self.interrupts > 0 })
    }

    /// Forwards an interrupt to the runs: on the first they write a checkpoint and exit, on the
    /// second they exit at once.
    fn on_interrupt(&mut self) {
        self.interrupts += 1;
        if self.interrupts == 1 {
            self.progress.message(
                "interrupted: the runs stop after writing a checkpoint (interrupt again to stop at \
                 once)",
            );
        }
        for job in &self.jobs {
            job.process.interrupt();
        }
    }

    fn start(&mut self, index: usize) {
        let (run, config) = &self.sweep.runs[index];
        let env_steps = match self.states[index] {
            RunState::Open { env_steps } => env_steps,
            _ => 0,
        };
        self.progress.message(&format!("{}: started", run.title()));
        match self.sweep.site.start(run, config, env_steps) {
            Ok(process) => self.jobs.push(Job { index, process }),
            Err(error) => self.fail(index, format!("{error:#}")),
        }
    }

    fn check_exits(&mut self) -> anyhow::Result<()> {
        let mut position = 0;
        while position < self.jobs.len() {
            match self.jobs[position].process.child.try_wait() {
                Ok(None) => position += 1,
                Ok(Some(status)) => {
                    let job = self.jobs.swap_remove(position);
                    self.on_exit(&job, status)?;
                }
                Err(error) => {
                    let job = self.jobs.swap_remove(position);
                    self.fail(job.index, format!("cannot wait for the process: {error}"));
                }
            }
        }
        Ok(())
    }

    fn on_exit(&mut self, job: &Job, status: ExitStatus) -> anyhow::Result<()> {
        let (run, config) = self.sweep.runs[job.index].clone();
        if !status.success() {
            if self.interrupts > 0 {
                // The run has advanced if it wrote a checkpoint.
                if let Ok(state) = self.sweep.site.state(&self.sweep.ledger, &run, &config) {
                    self.states[job.index] = state;
                }
                return Ok(());
            }
            self.fail(job.index, self.sweep.site.failure(&run, status));
            return Ok(());
        }
        let (wall_s, row) = match self.sweep.site.final_result(&run) {
            Ok(ended) => ended,
            Err(error) => {
                self.fail(job.index, format!("its results cannot be read: {error:#}"));
                return Ok(());
            }
        };
        let steps = config.run.steps;
        let env_steps = row.as_ref().map_or(steps, |row| row.env_steps);
        let (directory, state) = (run.directory.clone(), End::Finished);
        let finished = Finished { run: directory, steps, env_steps, wall_s, state };
        self.sweep.ledger.add(finished)?;
        let (steps, seconds) = job.process.measured(env_steps);
        self.estimate.add(RunKind::of_run(&run), steps, seconds);
        self.states[job.index] = RunState::Finished;
        let result = row.map_or_else(|| "no evaluation".to_owned(), |row| evaluation_text(&row));
        self.progress.message(&format!("{}: {result} after {wall_s:.0} s", run.title()));
        let remaining = self.remaining();
        self.progress.ended(remaining);
        Ok(())
    }

    fn fail(&mut self, index: usize, reason: String) {
        let title = self.sweep.runs[index].0.title();
        self.progress.message(&format!("{title}: failed: {reason}"));
        self.states[index] = RunState::Failed { reason };
        let remaining = self.remaining();
        self.progress.ended(remaining);
    }

    /// Estimates the remaining time.
    fn remaining(&self) -> Option<Duration> {
        let mut estimate = self.estimate.clone();
        let mut left = Vec::new();
        for job in &self.jobs {
            let (run, config) = &self.sweep.runs[job.index];
            let reached = self.sweep.site.measured_steps(run).max(job.process.env_steps);
            let (steps, seconds) = job.process.measured(reached);
            estimate.add(RunKind::of_run(run), steps, seconds);
            left.push((RunKind::of_run(run), config.run.steps.saturating_sub(reached)));
        }
        for &index in &self.waiting {
            let (run, config) = &self.sweep.runs[index];
            let RunState::Open { env_steps } = self.states[index] else { continue };
            left.push((RunKind::of_run(run), config.run.steps.saturating_sub(env_steps)));
        }
        estimate.remaining(left, self.sweep.jobs)
    }
}
