//! The loop of a trial: start, inject faults, wait for recovery, stop.

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
use super::journals::Journals;
use super::nemesis::Nemesis;
use super::post_run_checks;
use super::report::Report;
use super::samples::Samples;
use super::schedule::Schedule;
use super::subject::{CHECKPOINT_INTERVAL, REPLAY_STEPS, Subject};
use super::timeline::Timeline;
use super::violations::Violations;
use crate::journal::now_us;

/// Time limit from the start to the first segment of every worker [us].
const START_US: u64 = 120_000_000;
/// Time limit from the last strike until every worker has made progress [us].
const HEAL_US: u64 = 120_000_000;
/// Progress required for recovery: segments of each worker.
const HEAL_SEGMENTS: u64 = 50;
/// Interval between two turns. Thousands of records are written per second, and a checkpoint takes
/// some milliseconds.
const TURN: Duration = Duration::from_millis(4);
/// Interval between two lines of progress [us].
const TELL_US: u64 = 1_000_000;

/// Phase of a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Starting,
    Striking,
    Healing,
    /// There is nothing more to wait for.
    Over,
}

/// A running trial.
pub(super) struct Trial<'a> {
    plan: &'a TrialPlan,
    subject: Subject,
    journals: Journals,
    checker: Checker,
    timeline: Timeline,
    nemesis: Nemesis,
    samples: Option<Samples>,
    violations: Violations,
    phase: Phase,
    since_us: u64,
    struck_us: u64,
    /// Number of each worker's segments when the recovery began.
    before: Vec<u64>,
    interrupted: bool,
}

impl<'a> Trial<'a> {
    pub(super) fn new(plan: &'a TrialPlan, subject: Subject) -> anyhow::Result<Self> {
        let schedule = Schedule::new(plan.seed, plan.workers);
        let checkpoints = subject.run.join("checkpoints");
        Ok(Self {
            plan,
            journals: Journals::new(subject.journal.clone()),
            checker: Checker::new(plan.workers, CHECKPOINT_INTERVAL),
            timeline: Timeline::new(plan.workers, now_us()),
            nemesis: Nemesis::new(schedule, subject.pid()?, checkpoints),
            samples: None,
            violations: Violations::default(),
            phase: Phase::Starting,
            since_us: now_us(),
            struck_us: 0,
            before: Vec::new(),
            interrupted: false,
            subject,
        })
    }

    pub(super) fn run(mut self, watch: &Watch, progress: &dyn Progress) -> anyhow::Result<Report> {
        let mut tell_us = 0;
        while self.phase != Phase::Over {
            if watch.check().is_err() && !self.interrupted {
                self.interrupted = true;
                self.relent();
            }
            self.turn()?;
            let now = now_us();
            if now >= tell_us {
                tell_us = now + TELL_US;
                progress.state(&self.line(&self.told()));
            }
            std::thread::sleep(TURN);
        }
        progress.state(&self.line("stopping"));
        self.timeline.close(now_us());
        self.conclude()
    }

    fn line(&self, what: &str) -> String {
        let (elapsed, total) = (duration(self.struck()), duration(self.plan.duration));
        format!("{elapsed}/{total} {what}")
    }

    /// Stops the injection. The run must recover before it is stopped: only a live learner writes
    /// the last checkpoint, with which everything is compared.
    fn relent(&mut self) {
        match self.phase {
            Phase::Starting => self.enter(Phase::Over),
            Phase::Striking => {
                self.nemesis.relent(now_us(), &mut self.timeline);
                self.before = self.timeline.inserted();
                self.enter(Phase::Healing);
            }
            Phase::Healing | Phase::Over => {}
        }
    }

    /// Reads journals, injects faults, checks progress.
    fn turn(&mut self) -> anyhow::Result<()> {
        if let Some(how) = self.subject.end()? {
            if self.phase == Phase::Starting {
                bail!("dmprl train exited before the first fault: {how}");
            }
            self.violations.add(format!("I7: dmprl train exited unexpectedly: {how}"));
            self.phase = Phase::Over;
            return Ok(());
        }
        self.fold()?;
        let now = now_us();
        self.timeline.look(now);
        match self.phase {
            Phase::Starting => {
                if self.timeline.clear_since_us().is_some() {
                    self.enter(Phase::Striking);
                } else if now - self.since_us > START_US {
                    bail!(
                        "not every worker has delivered a segment within {} s",
                        START_US / 1_000_000
                    );
                }
            }
            Phase::Striking => {
                self.nemesis.step(now, &mut self.timeline)?;
                self.struck_us = now - self.since_us;
                if self.is_struck_enough() {
                    self.relent();
                }
            }
            Phase::Healing => {
                if self.is_healed() {
                    self.enter(Phase::Over);
                } else if now - self.since_us > HEAL_US {
                    let seconds = HEAL_US / 1_000_000;
                    self.violations.add(format!(
                        "I7: {seconds} s after the last strike workers went from {:?} segments to \
                         {:?}",
                        self.before,
                        self.timeline.inserted()
                    ));
                    self.enter(Phase::Over);
                }
            }
            Phase::Over => {}
        }
        self.sample(now)
    }

    fn enter(&mut self, phase: Phase) {
        (self.phase, self.since_us) = (phase, now_us());
    }

    fn fold(&mut self) -> anyhow::Result<()> {
        let Self { journals, checker, timeline, violations, .. } = self;
        journals.fold(violations, |author, record| {
            checker.take(author, record);
            timeline.take(author, record);
        })?;
        if ![&self.checker.violations, &self.timeline.violations, &self.violations]
            .iter()
            .all(|violations| violations.is_empty())
        {
            self.journals.keep();
        }
        Ok(())
    }

    fn struck(&self) -> Duration {
        Duration::from_micros(self.struck_us)
    }

    fn is_struck_enough(&self) -> bool {
        let done = self.nemesis.done;
        self.struck() >= self.plan.duration
            && done.worker_kills >= self.plan.worker_kills
            && done.learner_kills >= self.plan.learner_kills
    }

    fn is_healed(&self) -> bool {
        let now = self.timeline.inserted();
        let grown = |(now, before): (&u64, &u64)| *now >= before + HEAL_SEGMENTS;
        self.timeline.clear_since_us().is_some() && now.iter().zip(&self.before).all(grown)
    }

    /// Samples resources while faults are injected; the learner's once its replay is full and it is
    /// working.
    fn sample(&mut self, now: u64) -> anyhow::Result<()> {
        if self.phase != Phase::Striking {
            return Ok(());
        }
        let samples = match &mut self.samples {
            Some(samples) => samples,
            None => self.samples.insert(Samples::new(run_id(&self.subject.run)?)),
        };
        if !samples.is_due(now) {
            return Ok(());
        }
        let supervisor = self.subject.pid()?;
        let full = self.checker.standing().env_steps >= REPLAY_STEPS;
        let mut learner = None;
        if full && self.timeline.is_learner_back() {
            let members = members(supervisor)?;
            let found = members.iter().find(|it| matches!(it.role, Role::Learner(_)));
            learner = found.map(Member::pid);
        }
        samples.take(now, supervisor, learner);
        Ok(())
    }

    fn told(&self) -> String {
        let done = self.nemesis.done;
        let phase = match self.phase {
            Phase::Starting => "starting",
            Phase::Striking => "striking",
            Phase::Healing => "recovering",
            Phase::Over => "stopping",
        };
        let violations = [&self.checker.violations, &self.timeline.violations, &self.violations];
        let violations: u64 = violations.iter().map(|violations| violations.count()).sum();
        format!(
            "{phase} · killed {} workers, {} learners · {} segments · {violations} violations",
            done.worker_kills,
            done.learner_kills,
            self.checker.standing().segments
        )
    }

    /// Stops the run, if it still exists, and checks it.
    fn conclude(mut self) -> anyhow::Result<Report> {
        if self.subject.end()?.is_none()
            && let Some(how) = self.subject.stop()?
        {
            self.violations.add(format!("I8: dmprl train did not end as it should: {how}"));
        }
        self.fold()?;
        let sums = self.checker.conclude();
        let run = self.subject.run.clone();
        let mut samples = self.samples.take();
        // If interrupted before the first segment, missing files are no violation.
        if self.checker.standing().segments > 0 {
            self.violations
                .extend(post_run_checks::check_files(&run, &self.checker, &sums).into_sentences());
        }
        if let Ok(run_id) = run_id(&run) {
            let left = post_run_checks::check_leftovers(&run, &run_id, self.subject.pid()?)?;
            self.violations.extend(left.into_sentences());
            samples.get_or_insert_with(|| Samples::new(run_id));
        }
        self.violations.extend(std::mem::take(&mut self.checker.violations).into_sentences());
        self.violations.extend(std::mem::take(&mut self.timeline.violations).into_sentences());
        Ok(Report {
            seed: self.plan.seed,
            workers: self.plan.workers,
            seconds: self.struck_us as f64 / 1e6,
            interrupted: self.interrupted,
            done: self.nemesis.done,
            violations: self.violations.into_sentences(),
            sums,
            env_steps: self.checker.standing().env_steps,
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
