//! Runs trials, several in parallel, until all have ended or the user stops the search.

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
use super::remaining::{Ended, kind};
use crate::estimate::Estimate;
use crate::run::{RunProcess, result};
use crate::runner::{END_LOOK, LOOK};
use crate::tally::Tally;
use crate::{RunState, Site};

/// Interval between checks for new evaluations.
const EVALUATION_LOOK: Duration = Duration::from_millis(500);

/// A search to run.
pub struct SearchSweep {
    /// Location of the sweep.
    pub site: Site,
    /// The `[search]` table of the sweep file.
    pub search: Search,
    /// A study for every task with every method.
    pub studies: Vec<Study>,
    /// Number of parallel trials.
    pub jobs: usize,
    /// The finished runs in the output directory.
    pub ledger: Ledger,
    /// Python interpreter with Optuna.
    pub python: PathBuf,
    /// Function that returns the configuration for arguments of `dmprl train`.
    pub configure: fn(&[String]) -> anyhow::Result<ExperimentConfig>,
}

/// Result of a search. Its trials are in the studies.
#[derive(Debug)]
pub struct SearchReport {
    /// True if the user stopped it.
    pub interrupted: bool,
    /// Reason for which the search stopped early.
    pub gave_up: Option<String>,
}

/// Continues the running trials, and asks for others until there are enough.
///
/// # Errors
/// The storage or a run directory belongs to another search, or Optuna or the ledger fails. A
/// failed trial is no error of the search.
pub fn search(sweep: &mut SearchSweep, progress: &dyn Progress) -> anyhow::Result<SearchReport> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the search's runtime")?;
    runtime.block_on(async {
        let interrupts = interrupts()?;
        let optuna = Optuna::start(&sweep.python, &sweep.site.output).await?;
        let mut runner = Runner::new(sweep, optuna, progress);
        runner.open().await?;
        runner.sweep.site.keep_file()?;
        runner.run(interrupts).await
    })
}

/// A trial, by the index of its study and its own index.
pub(super) type Place = (usize, usize);

/// A running run.
pub(super) struct Job {
    pub(super) place: Place,
    /// Index of its seed in the list.
    pub(super) seed: usize,
    pub(super) run: PlannedRun,
    pub(super) process: RunProcess,
    pub(super) given_up: bool,
}

pub(super) struct Runner<'a> {
    pub(super) sweep: &'a mut SearchSweep,
    pub(super) optuna: Optuna,
    /// Running trials whose next run waits for a free job.
    pub(super) open: VecDeque<Place>,
    pub(super) jobs: Vec<Job>,
    /// Evaluations of running trials that have been reported to Optuna.
    pub(super) reported: BTreeMap<Place, BTreeSet<u64>>,
    /// Ended trials of each study.
    pub(super) ended: Vec<Ended>,
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
            ended: vec![Ended::default(); studies],
            estimate: Estimate::default(),
            progress: Tally::new(progress, "trials", count, 0),
            interrupts: 0,
            failed_in_a_row: 0,
            gave_up: None,
        }
    }

    /// Reads the trials in the storage.
    async fn open(&mut self) -> anyhow::Result<()> {
        let mut ended = 0;
        for index in 0..self.sweep.studies.len() {
            let study = &mut self.sweep.studies[index];
            let opened = self.optuna.open(&study.opening(&self.sweep.search)).await?;
            study.check_identity(&self.sweep.search, &opened.identity)?;
            let space = &self.sweep.search.space;
            let trials = opened.trials.iter().map(|stored| Trial::stored(space, stored));
            study.trials = trials.collect::<anyhow::Result<_>>()?;
            for (trial, stored) in opened.trials.into_iter().enumerate() {
                let place = (index, trial);
                self.reported.insert(place, stored.reported.into_iter().collect());
                ended += usize::from(self.found(place)?);
            }
            self.write_best(index)?;
        }
        self.progress.begin_at(ended);
        Ok(())
    }

    /// Adds a trial from the storage; returns true if it has ended.
    fn found(&mut self, place: Place) -> anyhow::Result<bool> {
        self.write(place)?;
        let (study, trial) = self.at(place);
        let (study, trial) = (study.clone(), trial.clone());
        for &seed in study.seeds.iter().filter(|_| !trial.values.is_empty()) {
            let run = study.run(&trial, seed);
            // Check that it matches the current file, if it exists.
            let config = (self.sweep.configure)(&run.arguments);
            let state =
                config.and_then(|config| self.sweep.site.state(&self.sweep.ledger, &run, &config));
            if trial.state != TrialState::Failed {
                state?;
            }
            if let Some(done) = self.sweep.ledger.of(&run.directory) {
                self.estimate.add(kind(&run), done.env_steps, done.wall_s);
            } else if trial.state == TrialState::Pruned && self.sweep.site.reached(&run) > 0 {
                // The search was killed after the pruning and before the end of the run.
                self.close_run(&run, &study, End::Pruned)?;
            }
        }
        match trial.state {
            TrialState::Running => self.open.push_back(place),
            TrialState::Finished | TrialState::Pruned => self.measure_trial(place),
            TrialState::Failed => {}
        }
        Ok(trial.state != TrialState::Running)
    }

    async fn run(mut self, mut interrupts: mpsc::Receiver<()>) -> anyhow::Result<SearchReport> {
        let mut look = tokio::time::interval(LOOK);
        let mut end_look = tokio::time::interval(END_LOOK);
        let mut evaluation_look = tokio::time::interval(EVALUATION_LOOK);
        loop {
            while self.interrupts == 0 && self.jobs.len() < self.sweep.jobs {
                let Some(place) = self.next().await? else { break };
                self.advance(place).await?;
            }
            if self.jobs.is_empty() {
                break;
            }
            tokio::select! {
                Some(()) = interrupts.recv() => self.on_interrupt(),
                _ = end_look.tick() => self.on_ends().await?,
                _ = evaluation_look.tick() => self.on_evaluations().await?,
                _ = look.tick() => self.progress.remaining(self.remaining()),
            }
        }
        let interrupted = self.interrupts > 0 && self.gave_up.is_none();
        Ok(SearchReport { interrupted, gave_up: self.gave_up })
    }

    /// Forwards each interrupt to the runs: on the first they write a checkpoint, on the second
    /// they exit at once.
    fn on_interrupt(&mut self) {
        self.interrupts += 1;
        if self.interrupts == 1 {
            self.progress.message("interrupted: the runs write a checkpoint (once more: at once)");
        }
        for job in &self.jobs {
            job.process.interrupt();
        }
    }

    pub(super) fn at(&self, (study, trial): Place) -> (&Study, &Trial) {
        let study = &self.sweep.studies[study];
        (study, &study.trials[trial])
    }

    /// Returns the next trial to advance: a running one, or a new one of the study with the fewest
    /// trials.
    async fn next(&mut self) -> anyhow::Result<Option<Place>> {
        if let Some(place) = self.open.pop_front() {
            return Ok(Some(place));
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
        let place = (index, study.trials.len() - 1);
        self.write(place)?;
        Ok(Some(place))
    }

    /// Starts the trial's next run, or ends the trial if there is none.
    async fn advance(&mut self, place: Place) -> anyhow::Result<()> {
        let (study, trial) = self.at(place);
        let (study, trial) = (study.clone(), trial.clone());
        for (seed, &number) in study.seeds.iter().enumerate() {
            let run = study.run(&trial, number);
            let config = match (self.sweep.configure)(&run.arguments) {
                Ok(config) => config,
                Err(error) => return self.fail(place, &run, format!("{error:#}")).await,
            };
            let state = self.sweep.site.state(&self.sweep.ledger, &run, &config)?;
            let rows = self.sweep.site.evaluations(&run)?;
            let is_last = seed + 1 == study.seeds.len();
            // The last evaluation is reported here, after a run has ended or a killed search
            // continues.
            let prune = self.report(place, seed, &rows).await?;
            match state {
                RunState::Finished if is_last => return self.finish(place).await,
                _ if prune => return self.prune(place, &run, rows.last()).await,
                RunState::Open { env_steps } => {
                    self.progress.message(&format!("{}: begins", run.title()));
                    match self.sweep.site.start(&run, &config, env_steps) {
                        Ok(process) => {
                            self.jobs.push(Job { place, seed, run, process, given_up: false })
                        }
                        Err(error) => self.fail(place, &run, format!("{error:#}")).await?,
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
        place: Place,
        seed: usize,
        rows: &[EvaluationRow],
    ) -> anyhow::Result<bool> {
        let mut prune = false;
        for row in rows {
            let (study, trial) = self.at(place);
            let number = study.evaluation_number(seed, row);
            let (name, trial, value) = (study.name(), trial.number, self.measure(study, row)?);
            if self.reported.entry(place).or_default().insert(number) {
                prune = self.optuna.report((&name, trial), number, value).await?;
            }
        }
        Ok(prune)
    }

    pub(super) fn measure(&self, study: &Study, row: &EvaluationRow) -> anyhow::Result<f64> {
        let objective = self.sweep.search.objective;
        objective.of(row).with_context(|| {
            format!(
                "search.objective = \"{}\": the evaluations of {} have no such rate; expected \
                 \"return\"",
                objective.name(),
                study.task
            )
        })
    }

    async fn on_evaluations(&mut self) -> anyhow::Result<()> {
        if self.interrupts > 0 {
            return Ok(()); // Its runs are ending, and a second interrupt would cut that short.
        }
        for index in 0..self.jobs.len() {
            let Job { place, seed, given_up, ref run, .. } = self.jobs[index];
            if given_up {
                continue;
            }
            let run = run.clone();
            // A run whose directory is being created or rewound has no rows to read.
            let mut rows = self.sweep.site.evaluations(&run).unwrap_or_default();
            // The last evaluation is reported after the run has ended.
            let steps = self.sweep.studies[place.0].base.run.steps;
            rows.retain(|row| row.env_steps < steps);
            if self.report(place, seed, &rows).await? {
                self.prune(place, &run, rows.last()).await?;
                self.jobs[index].given_up = true;
                self.jobs[index].process.interrupt();
            }
        }
        Ok(())
    }

    async fn on_ends(&mut self) -> anyhow::Result<()> {
        let mut index = 0;
        while index < self.jobs.len() {
            match self.jobs[index].process.child.try_wait() {
                Ok(None) => index += 1,
                Ok(Some(status)) => {
                    let job = self.jobs.swap_remove(index);
                    self.on_end(&job, status).await?;
                }
                Err(error) => {
                    let job = self.jobs.swap_remove(index);
                    let reason = format!("cannot wait for it: {error}");
                    self.fail(job.place, &job.run, reason).await?;
                }
            }
        }
        Ok(())
    }

    async fn on_end(&mut self, job: &Job, status: ExitStatus) -> anyhow::Result<()> {
        let study = self.sweep.studies[job.place.0].clone();
        let (steps, seconds) = job.process.measured(self.sweep.site.reached(&job.run));
        self.estimate.add(kind(&job.run), steps, seconds);
        if job.given_up {
            return self.close_run(&job.run, &study, End::Pruned).map(drop);
        }
        if !status.success() {
            if self.interrupts > 0 {
                return Ok(()); // Under way still; it goes on from its checkpoint.
            }
            let reason = self.sweep.site.failure(&job.run, status);
            return self.fail(job.place, &job.run, reason).await;
        }
        match self.close_run(&job.run, &study, End::Finished) {
            Ok(Some(row)) => {
                self.progress.message(&format!("{}: {}", job.run.title(), result(&row)));
                self.failed_in_a_row = 0;
                if self.interrupts == 0 {
                    // First in the queue, so that it precedes new trials; its last evaluation is
                    // then reported.
                    self.open.push_front(job.place);
                }
                Ok(())
            }
            Ok(None) => {
                let reason = "it has no evaluation".to_owned();
                self.fail(job.place, &job.run, reason).await
            }
            Err(error) => {
                let reason = format!("its results cannot be read: {error:#}");
                self.fail(job.place, &job.run, reason).await
            }
        }
    }

    pub(super) fn write(&self, place: Place) -> anyhow::Result<()> {
        let (study, trial) = self.at(place);
        trial.write(&self.sweep.site.output.join(&study.directory))
    }

    pub(super) fn write_best(&self, study: usize) -> anyhow::Result<()> {
        self.sweep.studies[study].write_best(&self.sweep.site.output, self.sweep.configure)
    }
}
