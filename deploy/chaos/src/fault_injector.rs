//! Injects the faults of the schedule into the run, one after the other. The trial's loop calls it
//! repeatedly, so it never blocks for long.

use std::path::PathBuf;
use std::time::Duration;

use dmprl_supervisor::members::{Member, Role, members};
use rustix::process::{Pid, Signal};

use super::schedule::{Fault, Schedule, ScheduledFault};
use super::timeline::Timeline;

/// Time that a fault waits for a suitable victim and moment [us]. Afterwards any moment will do, or
/// the fault is skipped.
const VICTIM_WAIT_US: u64 = 20_000_000;
/// Interval between checks for a checkpoint, and number of checks per call.
const CHECKPOINT_POLL_INTERVAL: Duration = Duration::from_micros(200);
const CHECKPOINT_POLLS_MAX: usize = 100;
/// Interval between checks for a victim [us]. Each one reads all of /proc.
const POLL_INTERVAL_US: u64 = 20_000;

/// Numbers of faults injected so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct FaultCounts {
    pub(super) worker_kills: u64,
    pub(super) learner_kills: u64,
    pub(super) evaluator_kills: u64,
    pub(super) stops: u64,
    /// Learners killed while they recovered, and while they wrote a checkpoint.
    pub(super) learner_kills_in_recovery: u64,
    pub(super) learner_kills_in_checkpoint: u64,
    /// Faults skipped for lack of a victim.
    pub(super) skipped: u64,
}

/// Progress of the current fault.
#[derive(Debug, Clone, Copy)]
enum Stage {
    /// Waits before the fault.
    Pause { until_us: u64 },
    /// Waits for a victim.
    Wait { deadline_us: u64, next_check_us: u64 },
    /// Waits for the successor of a killed learner, to kill it too.
    KillSuccessor(Successor),
    /// A process is suspended.
    Suspended { member: Member, until_us: u64 },
    /// Waits for a time without faults after the recovery from the last one.
    Rest { for_us: u64, deadline_us: u64 },
}

/// The successor of a killed learner, which is killed a given time after it appears.
#[derive(Debug, Clone, Copy)]
struct Successor {
    /// Number of learner deaths before the killed learner.
    deaths: u64,
    /// Time at which the successor was first seen.
    seen_us: Option<u64>,
    /// Time after which the fault is skipped.
    deadline_us: u64,
}

/// Injects the faults of a schedule.
pub(super) struct FaultInjector {
    schedule: Schedule,
    supervisor: Pid,
    checkpoints: PathBuf,
    scheduled: ScheduledFault,
    stage: Stage,
    /// Names of incomplete checkpoints that dead learners left behind.
    abandoned: Vec<String>,
    pub(super) counts: FaultCounts,
}

impl FaultInjector {
    pub(super) fn new(schedule: Schedule, supervisor: Pid, checkpoints: PathBuf) -> Self {
        let scheduled = ScheduledFault { pause_ms: 0, fault: Fault::Rest { for_ms: 0 } };
        let stage = Stage::Pause { until_us: 0 };
        let (abandoned, counts) = (Vec::new(), FaultCounts::default());
        Self { schedule, supervisor, checkpoints, scheduled, stage, abandoned, counts }
    }

    /// Performs the due actions.
    pub(super) fn step(&mut self, now_us: u64, timeline: &mut Timeline) -> anyhow::Result<()> {
        match self.stage {
            Stage::Pause { until_us } if now_us >= until_us => {
                let deadline_us = now_us + VICTIM_WAIT_US;
                self.stage = match self.scheduled.fault {
                    Fault::Rest { for_ms } => Stage::Rest { for_us: for_ms * 1_000, deadline_us },
                    _ => Stage::Wait { deadline_us, next_check_us: 0 },
                };
            }
            Stage::Wait { deadline_us, next_check_us } if now_us >= next_check_us => {
                let overdue = now_us >= deadline_us;
                if !self.try_inject(now_us, overdue, timeline)? {
                    self.stage =
                        Stage::Wait { deadline_us, next_check_us: now_us + POLL_INTERVAL_US };
                    if overdue {
                        self.counts.skipped += 1;
                        self.next(now_us);
                    }
                }
            }
            Stage::KillSuccessor(successor) => {
                self.kill_successor(successor, now_us, timeline)?;
            }
            Stage::Suspended { member, until_us } if now_us >= until_us => {
                self.resume(&member, now_us, timeline);
                self.next(now_us);
            }
            Stage::Rest { for_us, deadline_us } => {
                let rested = |since: u64| now_us >= since + for_us;
                if timeline.all_working_since_us().is_some_and(rested) || now_us >= deadline_us {
                    self.next(now_us);
                }
            }
            Stage::Pause { .. } | Stage::Wait { .. } | Stage::Suspended { .. } => {}
        }
        Ok(())
    }

    /// Stops the injection and resumes a suspended process.
    pub(super) fn stop_injection(&mut self, now_us: u64, timeline: &mut Timeline) {
        if let Stage::Suspended { member, .. } = self.stage {
            self.resume(&member, now_us, timeline);
        }
        self.stage = Stage::Pause { until_us: u64::MAX };
    }

    /// Moves on to the next fault of the schedule.
    fn next(&mut self, now_us: u64) {
        if let Some(scheduled) = self.schedule.next() {
            self.stage = Stage::Pause { until_us: now_us + scheduled.pause_ms * 1_000 };
            self.scheduled = scheduled;
        }
    }

    /// Tries to inject the current fault. Returns false if there is no suitable victim yet.
    fn try_inject(
        &mut self,
        now_us: u64,
        overdue: bool,
        timeline: &mut Timeline,
    ) -> anyhow::Result<bool> {
        let fault = self.scheduled.fault;
        // A learner must recover before its next fault, except in `KillLearnerTwice`. This check
        // comes before the expensive scan of /proc.
        if fault.targets_learner() && !overdue && !timeline.is_learner_working() {
            return Ok(false);
        }
        let members = members(self.supervisor)?;
        // Checked after the scan of /proc, because a checkpoint takes only milliseconds.
        if fault == Fault::KillLearnerInCheckpoint && !overdue && !self.wait_for_checkpoint() {
            return Ok(false);
        }
        Ok(match fault {
            Fault::KillWorker { worker, early } => {
                let ready = early || overdue || timeline.is_working(worker);
                let victim = members.iter().find(|it| is_worker(it, worker)).filter(|_| ready);
                victim.is_some_and(|victim| self.kill(victim, now_us, timeline))
                    && self.finish(now_us)
            }
            Fault::KillWorkers => {
                let workers = members.iter().filter(|it| matches!(it.role, Role::Worker(..)));
                let killed: u32 =
                    workers.map(|it| u32::from(self.kill(it, now_us, timeline))).sum();
                killed > 0 && self.finish(now_us)
            }
            Fault::KillLearner | Fault::KillLearnerInCheckpoint => {
                let killed = self.kill_learner(&members, now_us, timeline).is_some();
                if killed && fault == Fault::KillLearnerInCheckpoint && !overdue {
                    // If the checkpoint was incomplete, it still is.
                    self.counts.learner_kills_in_checkpoint +=
                        u64::from(self.is_checkpoint_in_progress());
                }
                killed && self.finish(now_us)
            }
            Fault::KillLearnerTwice { .. } => {
                let killed = self.kill_learner(&members, now_us, timeline);
                if let Some(deaths) = killed {
                    let deadline_us = now_us + VICTIM_WAIT_US;
                    let successor = Successor { deaths, seen_us: None, deadline_us };
                    self.stage = Stage::KillSuccessor(successor);
                }
                killed.is_some()
            }
            Fault::StopWorker { worker, for_ms } => {
                let victim = members.iter().find(|it| is_worker(it, worker));
                victim.is_some_and(|victim| self.suspend(victim, now_us, for_ms, timeline))
            }
            Fault::StopLearner { for_ms } => {
                let victim = members.iter().find(|it| is_learner(it));
                victim.is_some_and(|victim| self.suspend(victim, now_us, for_ms, timeline))
            }
            Fault::KillEvaluator => {
                let victim = members.iter().find(|it| it.role == Role::Evaluator);
                victim.is_some_and(|victim| self.kill(victim, now_us, timeline))
                    && self.finish(now_us)
            }
            Fault::Rest { .. } => self.finish(now_us),
        })
    }

    /// Moves on to the next fault, and returns true as the result of an injection.
    fn finish(&mut self, now_us: u64) -> bool {
        self.next(now_us);
        true
    }

    /// Kills the learner's successor once it is due.
    fn kill_successor(
        &mut self,
        successor: Successor,
        now_us: u64,
        timeline: &mut Timeline,
    ) -> anyhow::Result<()> {
        let Fault::KillLearnerTwice { after_ms } = self.scheduled.fault else {
            self.next(now_us);
            return Ok(());
        };
        let Successor { deaths, seen_us, deadline_us } = successor;
        let due = seen_us.is_some_and(|seen| now_us >= seen + after_ms * 1_000);
        if seen_us.is_none() || due {
            let members = members(self.supervisor)?;
            let is_successor = |it: &Member| matches!(it.role, Role::Learner(n) if n > deaths);
            let exists = members.iter().any(is_successor);
            if due && exists {
                let recovering = !timeline.is_learner_working();
                if self.kill_learner(&members, now_us, timeline).is_some() {
                    self.counts.learner_kills_in_recovery += u64::from(recovering);
                }
                self.next(now_us);
                return Ok(());
            }
            let seen_us = seen_us.or(exists.then_some(now_us));
            self.stage = Stage::KillSuccessor(Successor { seen_us, ..successor });
        }
        if now_us >= deadline_us {
            self.counts.skipped += 1;
            self.next(now_us);
        }
        Ok(())
    }

    /// Waits briefly for the learner to begin a checkpoint.
    fn wait_for_checkpoint(&mut self) -> bool {
        // Learners that were killed while writing a checkpoint have left it behind.
        self.abandoned = self.incomplete_checkpoints();
        (0..CHECKPOINT_POLLS_MAX).any(|_| {
            std::thread::sleep(CHECKPOINT_POLL_INTERVAL);
            self.is_checkpoint_in_progress()
        })
    }

    /// Returns true if the learner is writing a checkpoint, or was killed while writing one.
    fn is_checkpoint_in_progress(&self) -> bool {
        self.incomplete_checkpoints().iter().any(|name| !self.abandoned.contains(name))
    }

    /// Lists the names of incomplete checkpoints.
    fn incomplete_checkpoints(&self) -> Vec<String> {
        let entries = self.checkpoints.read_dir().into_iter().flatten().flatten();
        let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
        names.filter(|name| name.starts_with(".0") && name.ends_with(".tmp")).collect()
    }

    fn kill(&mut self, victim: &Member, now_us: u64, timeline: &mut Timeline) -> bool {
        if !victim.signal(Signal::KILL) {
            return false;
        }
        match victim.role {
            Role::Worker(index, incarnation) => {
                self.counts.worker_kills += 1;
                timeline.worker_killed(index, incarnation, now_us);
            }
            Role::Learner(deaths) => {
                self.counts.learner_kills += 1;
                timeline.learner_killed(deaths, now_us);
            }
            Role::Evaluator => self.counts.evaluator_kills += 1,
        }
        true
    }

    /// Kills the learner, and returns the number of learner deaths before it.
    fn kill_learner(
        &mut self,
        members: &[Member],
        now_us: u64,
        timeline: &mut Timeline,
    ) -> Option<u64> {
        let victim = members.iter().find(|it| is_learner(it))?;
        let Role::Learner(deaths) = victim.role else { return None };
        self.kill(victim, now_us, timeline).then_some(deaths)
    }

    fn suspend(
        &mut self,
        victim: &Member,
        now_us: u64,
        for_ms: u64,
        timeline: &mut Timeline,
    ) -> bool {
        if !victim.signal(Signal::STOP) {
            return false;
        }
        self.counts.stops += 1;
        let until_us = now_us + for_ms * 1_000;
        record_suspension(victim, until_us, timeline);
        self.stage = Stage::Suspended { member: *victim, until_us };
        true
    }

    fn resume(&mut self, member: &Member, now_us: u64, timeline: &mut Timeline) {
        // The process still exists: only this trial kills it.
        let _ = member.signal(Signal::CONT);
        record_suspension(member, now_us, timeline);
    }
}

fn is_worker(member: &Member, worker: u32) -> bool {
    matches!(member.role, Role::Worker(index, _) if index == worker)
}

fn is_learner(member: &Member) -> bool {
    matches!(member.role, Role::Learner(_))
}

/// Records that a process is suspended until `until_us`. Segments sent before that time do not
/// prove its recovery.
fn record_suspension(member: &Member, until_us: u64, timeline: &mut Timeline) {
    match member.role {
        Role::Worker(index, _) => timeline.worker_stopped(index, until_us),
        Role::Learner(_) => timeline.learner_stopped(until_us),
        Role::Evaluator => {}
    }
}
