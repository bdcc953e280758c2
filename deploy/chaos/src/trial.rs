//! The main loop of a trial: start, inject faults, wait for recovery, stop.

use std::path::Path;
use std::time::Duration;

use anyhow::bail;
use dmprl_run::Progress;
use dmprl_run::RunDirectory;
use dmprl_run::Watch;
use dmprl_run::format::duration;
use dmprl_supervisor::members::{Member, Role, members};

use super::TrialPlan;
use super::checker::Checker;
use super::fault_injector::FaultInjector;
use super::journals::Journals;
use super::post_run_checks;
use super::report::Report;
use super::run_under_test::{CHECKPOINT_INTERVAL, REPLAY_STEPS, RunUnderTest};
use super::samples::Samples;
use super::schedule::Schedule;
use super::timeline::Timeline;
use super::violations::Violations;
use crate::journal::now_us;

/// Time limit from the start to the first segment of every worker [us].
const START_US: u64 = 120_000_000;
/// Time limit from the last fault until every worker has made progress [us].
const RECOVERY_US: u64 = 120_000_000;
/// Progress required for recovery: inserted segments of each worker.
const RECOVERY_SEGMENTS: u64 = 50;
/// Interval between two turns. It is short, because thousands of records are written per second and
/// a checkpoint takes only some milliseconds.
const TURN_INTERVAL: Duration = Duration::from_millis(4);
/// Interval between two lines of progress [us].
const PROGRESS_INTERVAL_US: u64 = 1_000_000;

/// Phase of a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Starting,
    Injecting,
    Recovering,
    /// The run can be stopped.
    Done,
}

/// A running trial.
pub(super) struct Trial<'a> {
    plan: &'a TrialPlan,
    run_under_test: RunUnderTest,
    journals: Journals,
    checker: Checker,
    timeline: Timeline,
    injector: FaultInjector,
    samples: Option<Samples>,
    violations: Violations,
    phase: Phase,
    phase_since_us: u64,
    injected_us: u64,
    /// Number of inserted segments of each worker when the injection stopped.
    inserted_before: Vec<u64>,
    interrupted: bool,
}

impl<'a> Trial<'a> {
    pub(super) fn new(plan: &'a TrialPlan, run_under_test: RunUnderTest) -> anyhow::Result<Self> {
        let schedule = Schedule::new(plan.seed, plan.workers);
        let checkpoints = run_under_test.run.join("checkpoints");
        Ok(Self {
            plan,
            journals: Journals::new(run_under_test.journal.clone()),
            checker: Checker::new(plan.workers, CHECKPOINT_INTERVAL),
            timeline: Timeline::new(plan.workers, now_us()),
            injector: FaultInjector::new(schedule, run_under_test.pid()?, checkpoints),
            samples: None,
            violations: Violations::default(),
            phase: Phase::Starting,
            phase_since_us: now_us(),
            injected_us: 0,
            inserted_before: Vec::new(),
            interrupted: false,
            run_under_test,
        })
    }

    pub(super) fn run(mut self, watch: &Watch, progress: &dyn Progress) -> anyhow::Result<Report> {
        let mut next_line_us = 0;
        while self.phase != Phase::Done {
            if watch.check().is_err() && !self.interrupted {
                self.interrupted = true;
                self.stop_injection();
            }
            self.turn()?;
            let now = now_us();
            if now >= next_line_us {
                next_line_us = now + PROGRESS_INTERVAL_US;
                progress.state(&self.line(&self.status()));
            }
            std::thread::sleep(TURN_INTERVAL);
        }
        progress.state(&self.line("stopping"));
        self.timeline.finish(now_us());
        self.conclude()
    }

    fn line(&self, what: &str) -> String {
        let (elapsed, total) = (duration(self.injected()), duration(self.plan.duration));
        format!("{elapsed}/{total} {what}")
    }

    /// Stops the injection of faults. The run must then recover before it is stopped, because only
    /// a live learner writes the last checkpoint, with which the journals are compared.
    fn stop_injection(&mut self) {
        match self.phase {
            Phase::Starting => self.enter(Phase::Done),
            Phase::Injecting => {
                self.injector.stop_injection(now_us(), &mut self.timeline);
                self.inserted_before = self.timeline.inserted();
                self.enter(Phase::Recovering);
            }
            Phase::Recovering | Phase::Done => {}
        }
    }

    /// Reads journals, injects faults, checks progress.
    fn turn(&mut self) -> anyhow::Result<()> {
        if let Some(how) = self.run_under_test.end()? {
            if self.phase == Phase::Starting {
                bail!("dmprl train exited before the first fault: {how}");
            }
            self.violations.add(format!("I7: dmprl train exited unexpectedly: {how}"));
            self.phase = Phase::Done;
            return Ok(());
        }
        self.read_journals()?;
        let now = now_us();
        self.timeline.check_progress(now);
        match self.phase {
            Phase::Starting => {
                if self.timeline.all_working_since_us().is_some() {
                    self.enter(Phase::Injecting);
                } else if now - self.phase_since_us > START_US {
                    bail!(
                        "not every worker has delivered a segment within {} s",
                        START_US / 1_000_000
                    );
                }
            }
            Phase::Injecting => {
                self.injector.step(now, &mut self.timeline)?;
                self.injected_us = now - self.phase_since_us;
                if self.is_injection_complete() {
                    self.stop_injection();
                }
            }
            Phase::Recovering => {
                if self.has_recovered() {
                    self.enter(Phase::Done);
                } else if now - self.phase_since_us > RECOVERY_US {
                    let seconds = RECOVERY_US / 1_000_000;
                    self.violations.add(format!(
                        "I7: in {seconds} s after the last fault, the workers went from {:?} \
                         segments to {:?}",
                        self.inserted_before,
                        self.timeline.inserted()
                    ));
                    self.enter(Phase::Done);
                }
            }
            Phase::Done => {}
        }
        self.sample(now)
    }

    fn enter(&mut self, phase: Phase) {
        (self.phase, self.phase_since_us) = (phase, now_us());
    }

    fn read_journals(&mut self) -> anyhow::Result<()> {
        let Self { journals, checker, timeline, violations, .. } = self;
        journals.for_each_new(violations, |author, record| {
            checker.process(author, record);
            timeline.process(author, record);
        })?;
        if ![&self.checker.violations, &self.timeline.violations, &self.violations]
            .iter()
            .all(|violations| violations.is_empty())
        {
            self.journals.keep();
        }
        Ok(())
    }

    fn injected(&self) -> Duration {
        Duration::from_micros(self.injected_us)
    }

    fn is_injection_complete(&self) -> bool {
        let faults = self.injector.counts;
        self.injected() >= self.plan.duration
            && faults.worker_kills >= self.plan.worker_kills
            && faults.learner_kills >= self.plan.learner_kills
    }

    fn has_recovered(&self) -> bool {
        let now = self.timeline.inserted();
        let grown = |(now, before): (&u64, &u64)| *now >= before + RECOVERY_SEGMENTS;
        self.timeline.all_working_since_us().is_some()
            && now.iter().zip(&self.inserted_before).all(grown)
    }

    /// Samples resources while faults are injected, those of the learner only while it works and
    /// its replay is full.
    fn sample(&mut self, now: u64) -> anyhow::Result<()> {
        if self.phase != Phase::Injecting {
            return Ok(());
        }
        let samples = match &mut self.samples {
            Some(samples) => samples,
            None => self.samples.insert(Samples::new(run_id(&self.run_under_test.run)?)),
        };
        if !samples.is_due(now) {
            return Ok(());
        }
        let supervisor = self.run_under_test.pid()?;
        let full = self.checker.counters().env_steps >= REPLAY_STEPS;
        let mut learner = None;
        if full && self.timeline.is_learner_working() {
            let members = members(supervisor)?;
            let found = members.iter().find(|it| matches!(it.role, Role::Learner(_)));
            learner = found.map(Member::pid);
        }
        samples.take(now, supervisor, learner);
        Ok(())
    }

    fn status(&self) -> String {
        let faults = self.injector.counts;
        let phase = match self.phase {
            Phase::Starting => "starting",
            Phase::Injecting => "injecting faults",
            Phase::Recovering => "recovering",
            Phase::Done => "stopping",
        };
        let violations = [&self.checker.violations, &self.timeline.violations, &self.violations];
        let violations: u64 = violations.iter().map(|violations| violations.count()).sum();
        format!(
            "{phase} · killed {} workers, {} learners · {} segments · {violations} violations",
            faults.worker_kills,
            faults.learner_kills,
            self.checker.counters().segments
        )
    }

    /// Stops the run if it is still running, and checks it.
    fn conclude(mut self) -> anyhow::Result<Report> {
        if self.run_under_test.end()?.is_none()
            && let Some(how) = self.run_under_test.stop()?
        {
            self.violations.add(format!("I8: dmprl train did not end cleanly: {how}"));
        }
        self.read_journals()?;
        let sums = self.checker.conclude();
        let run = self.run_under_test.run.clone();
        let mut samples = self.samples.take();
        // If interrupted before the first segment, the run may have no files yet.
        if self.checker.counters().segments > 0 {
            self.violations
                .extend(post_run_checks::check_files(&run, &self.checker, &sums).into_sentences());
        }
        if let Ok(run_id) = run_id(&run) {
            let left = post_run_checks::check_leftovers(&run, &run_id, self.run_under_test.pid()?)?;
            self.violations.extend(left.into_sentences());
            samples.get_or_insert_with(|| Samples::new(run_id));
        }
        self.violations.extend(std::mem::take(&mut self.checker.violations).into_sentences());
        self.violations.extend(std::mem::take(&mut self.timeline.violations).into_sentences());
        Ok(Report {
            seed: self.plan.seed,
            workers: self.plan.workers,
            seconds: self.injected_us as f64 / 1e6,
            interrupted: self.interrupted,
            faults: self.injector.counts,
            violations: self.violations.into_sentences(),
            sums,
            env_steps: self.checker.counters().env_steps,
            checkpoints: self.checker.checkpoints(),
            worker_back_s: self.timeline.worker_back_s.clone(),
            learner_back_s: self.timeline.learner_back_s.clone(),
            undisturbed: self.timeline.undisturbed(),
            undisturbed_s: self.timeline.undisturbed_us as f64 / 1e6,
            samples: samples.unwrap_or_else(|| Samples::new(String::new())),
            kept: None,
        })
    }
}

fn run_id(run: &Path) -> anyhow::Result<String> {
    Ok(RunDirectory::open(run)?.manifest()?.run_id)
}
