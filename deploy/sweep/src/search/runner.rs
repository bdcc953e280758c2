//! Runs trials, several in parallel, until all have ended or the user interrupts.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::PathBuf;
use std::process::ExitStatus;
use std::time::Duration;

use anyhow::Context;
use dmprl_run::Progress;
use dmprl_run::sweep_files::Search;
use dmprl_run::sweep_files::Study;
use dmprl_run::sweep_files::{End, Ledger, PlannedRun};
use dmprl_run::sweep_files::{Trial, TrialState};
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::supervision::EvaluationRow;
use dmprl_supervisor::interrupts;
use tokio::sync::mpsc;

use super::optuna::Optuna;
use super::remaining::EndedTrials;
use crate::estimate::{Estimate, RunKind};
use crate::run::{RunProcess, evaluation_text};
use crate::runner::{EXIT_POLL_INTERVAL, PROGRESS_INTERVAL};
use crate::tally::Tally;
use crate::{RunState, Site};

/// Interval between checks for new evaluations.
const EVALUATION_POLL_INTERVAL: Duration = Duration::from_millis(500);

/// A search to run, with its studies.
pub struct SearchSweep {
    /// Output directory and program.
    pub site: Site,
    /// The `[search]` table of the sweep file.
    pub search: Search,
    /// One study for each combination of task and method.
    pub studies: Vec<Study>,
    /// Number of parallel trials.
    pub jobs: usize,
    /// Finished runs in the output directory.
    pub ledger: Ledger,
    /// Python interpreter with Optuna.
    pub python: PathBuf,
    /// Function that returns the configuration for arguments of `dmprl train`.
    pub configure: fn(&[String]) -> anyhow::Result<ExperimentConfig>,
}

/// Result of a search. Its trials are in the studies.
#[derive(Debug)]
pub struct SearchReport {
    /// True if the user interrupted the search.
    pub interrupted: bool,
    /// Why the search stopped early; `None` if it did not.
    pub gave_up: Option<String>,
}

/// Continues the running trials, and asks Optuna for new ones until each study has enough.
///
/// # Errors
/// The storage or a run directory belongs to another search, Optuna fails, or the ledger cannot be
/// written. A failed trial is not an error.
pub fn search(sweep: &mut SearchSweep, progress: &dyn Progress) -> anyhow::Result<SearchReport> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the search's runtime")?;
    runtime.block_on(async {
        let interrupts = interrupts()?;
        let optuna = Optuna::start(&sweep.python, &sweep.site.output).await?;
        let mut runner = Runner::new(sweep, optuna, progress);
        runner.load_studies().await?;
        runner.sweep.site.save_sweep_file()?;
        runner.run(interrupts).await
    })
}

/// Index of a trial's study, and of the trial in the study.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct TrialId {
    pub(super) study: usize,
    pub(super) trial: usize,
}

/// A run in progress.
pub(super) struct Job {
    pub(super) trial: TrialId,
    /// Index of its seed in the study's seeds.
    pub(super) seed: usize,
    pub(super) run: PlannedRun,
    pub(super) process: RunProcess,
    pub(super) pruned: bool,
}

pub(super) struct Runner<'a> {
    pub(super) sweep: &'a mut SearchSweep,
    pub(super) optuna: Optuna,
    /// Running trials without a job.
    pub(super) open: VecDeque<TrialId>,
    pub(super) jobs: Vec<Job>,
    /// Numbers of the evaluations reported to Optuna.
    pub(super) reported: BTreeMap<TrialId, BTreeSet<u64>>,
    /// Number and steps of each study's ended trials.
    pub(super) ended: Vec<EndedTrials>,
    pub(super) estimate: Estimate,
    pub(super) progress: Tally<'a>,
    pub(super) interrupts: u32,
    pub(super) failed_in_a_row: u32,
    pub(super) gave_up: Option<String>,
}

impl<'a> Runner<'a> {
    fn new(sweep: &'a mut SearchSweep, optuna: Optuna, progress: &'a dyn Progress) -> Self {
        let studies = sweep.studies.len();
        let count = studies * sweep.search.trials as usize;
        Self {
            sweep,
            optuna,
            open: VecDeque::new(),
            jobs: Vec::new(),
            reported: BTreeMap::new(),
            ended: vec![EndedTrials::default(); studies],
            estimate: Estimate::default(),
            progress: Tally::new(progress, "trials", count, 0),
            interrupts: 0,
            failed_in_a_row: 0,
            gave_up: None,
        }
    }

    /// Opens the studies and reads their trials from the storage.
    async fn load_studies(&mut self) -> anyhow::Result<()> {
        let mut ended = 0;
        for index in 0..self.sweep.studies.len() {
            let study = &mut self.sweep.studies[index];
            let opened = self.optuna.open(&study.opening(&self.sweep.search)).await?;
            study.check_identity(&self.sweep.search, &opened.identity)?;
            let space = &self.sweep.search.space;
            let trials = opened.trials.iter().map(|stored| Trial::stored(space, stored));
            study.trials = trials.collect::<anyhow::Result<_>>()?;
            for (trial, stored) in opened.trials.into_iter().enumerate() {
                let id = TrialId { study: index, trial };
                self.reported.insert(id, stored.reported.into_iter().collect());
                ended += usize::from(self.restore(id)?);
            }
            self.write_best(index)?;
        }
        self.progress.set_ended(ended);
        Ok(())
    }

    /// Restores a trial from the storage; returns true if it has ended.
    fn restore(&mut self, id: TrialId) -> anyhow::Result<bool> {
        self.write_trial(id)?;
        let (study, trial) = self.study_and_trial(id);
        let (study, trial) = (study.clone(), trial.clone());
        for &seed in study.seeds.iter().filter(|_| !trial.values.is_empty()) {
            let run = study.run(&trial, seed);
            // Checks that an existing run matches the current sweep file.
            let config = (self.sweep.configure)(&run.arguments);
            let state =
                config.and_then(|config| self.sweep.site.state(&self.sweep.ledger, &run, &config));
            if trial.state != TrialState::Failed {
                state?;
            }
            if let Some(done) = self.sweep.ledger.of(&run.directory) {
                self.estimate.add(RunKind::of_run(&run), done.env_steps, done.wall_s);
            } else if trial.state == TrialState::Pruned && self.sweep.site.measured_steps(&run) > 0
            {
                // The search was killed after it pruned the trial and before the run ended.
                self.add_to_ledger(&run, &study, End::Pruned)?;
            }
        }
        match trial.state {
            TrialState::Running => self.open.push_back(id),
            TrialState::Finished | TrialState::Pruned => self.add_trial_steps(id),
            TrialState::Failed => {}
        }
        Ok(trial.state != TrialState::Running)
    }

    async fn run(mut self, mut interrupts: mpsc::Receiver<()>) -> anyhow::Result<SearchReport> {
        let mut progress_tick = tokio::time::interval(PROGRESS_INTERVAL);
        let mut exit_poll = tokio::time::interval(EXIT_POLL_INTERVAL);
        let mut evaluation_poll = tokio::time::interval(EVALUATION_POLL_INTERVAL);
        loop {
            while self.interrupts == 0 && self.jobs.len() < self.sweep.jobs {
                let Some(id) = self.next_trial().await? else { break };
                self.advance(id).await?;
            }
            if self.jobs.is_empty() {
                break;
            }
            tokio::select! {
                Some(()) = interrupts.recv() => self.on_interrupt(),
                _ = exit_poll.tick() => self.check_exits().await?,
                _ = evaluation_poll.tick() => self.check_evaluations().await?,
                _ = progress_tick.tick() => self.progress.remaining(self.remaining()),
            }
        }
        let interrupted = self.interrupts > 0 && self.gave_up.is_none();
        Ok(SearchReport { interrupted, gave_up: self.gave_up })
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

    pub(super) fn study_and_trial(&self, id: TrialId) -> (&Study, &Trial) {
        let study = &self.sweep.studies[id.study];
        (study, &study.trials[id.trial])
    }

    /// Returns the next trial to advance: a running one without a job, else a new one of the study
    /// with the fewest trials.
    async fn next_trial(&mut self) -> anyhow::Result<Option<TrialId>> {
        if let Some(id) = self.open.pop_front() {
            return Ok(Some(id));
        }
        let wanted = self.sweep.search.trials as usize;
        let studies = self.sweep.studies.iter().enumerate();
        let fewest = studies
            .filter(|(_, study)| study.trials.len() < wanted)
            .min_by_key(|(_, study)| study.trials.len());
        let Some(index) = fewest.map(|(index, _)| index) else { return Ok(None) };
        let study = &mut self.sweep.studies[index];
        let asked = self.optuna.ask(&study.name()).await?;
        study.trials.push(Trial::new(&self.sweep.search.space, asked.trial, &asked.values)?);
        let id = TrialId { study: index, trial: study.trials.len() - 1 };
        self.write_trial(id)?;
        Ok(Some(id))
    }

    /// Starts the trial's next run, or ends the trial if there is none.
    async fn advance(&mut self, id: TrialId) -> anyhow::Result<()> {
        let (study, trial) = self.study_and_trial(id);
        let (study, trial) = (study.clone(), trial.clone());
        for (seed, &number) in study.seeds.iter().enumerate() {
            let run = study.run(&trial, number);
            let config = match (self.sweep.configure)(&run.arguments) {
                Ok(config) => config,
                Err(error) => return self.fail(id, &run, format!("{error:#}")).await,
            };
            let state = self.sweep.site.state(&self.sweep.ledger, &run, &config)?;
            let rows = self.sweep.site.evaluations(&run)?;
            let is_last = seed + 1 == study.seeds.len();
            // A run's last evaluation is reported here, after the run has ended or when a killed
            // search continues.
            let prune = self.report(id, seed, &rows).await?;
            match state {
                RunState::Finished if is_last => return self.finish(id).await,
                _ if prune => return self.prune(id, &run, rows.last()).await,
                RunState::Open { env_steps } => {
                    self.progress.message(&format!("{}: started", run.title()));
                    match self.sweep.site.start(&run, &config, env_steps) {
                        Ok(process) => {
                            self.jobs.push(Job { trial: id, seed, run, process, pruned: false })
                        }
                        Err(error) => self.fail(id, &run, format!("{error:#}")).await?,
                    }
                    return Ok(());
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Reports new evaluations to Optuna; returns true if the trial should be pruned.
    async fn report(
        &mut self,
        id: TrialId,
        seed: usize,
        rows: &[EvaluationRow],
    ) -> anyhow::Result<bool> {
        let mut prune = false;
        for row in rows {
            let (study, trial) = self.study_and_trial(id);
            let number = study.evaluation_number(seed, row);
            let (name, trial, value) = (study.name(), trial.number, self.measure(study, row)?);
            if self.reported.entry(id).or_default().insert(number) {
                prune = self.optuna.report(&name, trial, number, value).await?;
            }
        }
        Ok(prune)
    }

    /// Returns the value of the search's objective in an evaluation.
    pub(super) fn measure(&self, study: &Study, row: &EvaluationRow) -> anyhow::Result<f64> {
        let objective = self.sweep.search.objective;
        objective.of(row).with_context(|| {
            format!(
                "search.objective = \"{}\": {} does not report success; expected \"return\"",
                objective.name(),
                study.task
            )
        })
    }

    /// Reports new evaluations of the running runs, and interrupts the runs of pruned trials.
    async fn check_evaluations(&mut self) -> anyhow::Result<()> {
        if self.interrupts > 0 {
            // The runs are already stopping. Interrupting one again would stop it without a
            // checkpoint.
            return Ok(());
        }
        for index in 0..self.jobs.len() {
            let Job { trial: id, seed, pruned, ref run, .. } = self.jobs[index];
            if pruned {
                continue;
            }
            let run = run.clone();
            // Reading fails while the run's directory is being created or rewound.
            let mut rows = self.sweep.site.evaluations(&run).unwrap_or_default();
            // `advance` reports the last evaluation after the run has ended.
            let steps = self.sweep.studies[id.study].base.run.steps;
            rows.retain(|row| row.env_steps < steps);
            if self.report(id, seed, &rows).await? {
                self.prune(id, &run, rows.last()).await?;
                self.jobs[index].pruned = true;
                self.jobs[index].process.interrupt();
            }
        }
        Ok(())
    }

    async fn check_exits(&mut self) -> anyhow::Result<()> {
        let mut index = 0;
        while index < self.jobs.len() {
            match self.jobs[index].process.child.try_wait() {
                Ok(None) => index += 1,
                Ok(Some(status)) => {
                    let job = self.jobs.swap_remove(index);
                    self.on_exit(&job, status).await?;
                }
                Err(error) => {
                    let job = self.jobs.swap_remove(index);
                    let reason = format!("cannot wait for the process: {error}");
                    self.fail(job.trial, &job.run, reason).await?;
                }
            }
        }
        Ok(())
    }

    async fn on_exit(&mut self, job: &Job, status: ExitStatus) -> anyhow::Result<()> {
        let study = self.sweep.studies[job.trial.study].clone();
        let (steps, seconds) = job.process.measured(self.sweep.site.measured_steps(&job.run));
        self.estimate.add(RunKind::of_run(&job.run), steps, seconds);
        if job.pruned {
            return self.add_to_ledger(&job.run, &study, End::Pruned).map(drop);
        }
        if !status.success() {
            if self.interrupts > 0 {
                // The run can be resumed from its checkpoint.
                return Ok(());
            }
            let reason = self.sweep.site.failure(&job.run, status);
            return self.fail(job.trial, &job.run, reason).await;
        }
        match self.add_to_ledger(&job.run, &study, End::Finished) {
            Ok(Some(row)) => {
                self.progress.message(&format!("{}: {}", job.run.title(), evaluation_text(&row)));
                self.failed_in_a_row = 0;
                if self.interrupts == 0 {
                    // At the front of the queue, so that the trial is advanced before others, which
                    // also reports the run's last evaluation.
                    self.open.push_front(job.trial);
                }
                Ok(())
            }
            Ok(None) => {
                let reason = "the run has no evaluation".to_owned();
                self.fail(job.trial, &job.run, reason).await
            }
            Err(error) => {
                let reason = format!("its results cannot be read: {error:#}");
                self.fail(job.trial, &job.run, reason).await
            }
        }
    }

    /// Writes a trial's `trial.json`.
    pub(super) fn write_trial(&self, id: TrialId) -> anyhow::Result<()> {
        let (study, trial) = self.study_and_trial(id);
        trial.write(&self.sweep.site.output.join(&study.directory))
    }

    /// Writes the best configuration of a study.
    pub(super) fn write_best(&self, study: usize) -> anyhow::Result<()> {
        self.sweep.studies[study].write_best(&self.sweep.site.output, self.sweep.configure)
    }
}
