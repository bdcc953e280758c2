//! Injects the faults of the schedule into the run, one after the other, without blocking for long:
//! the trial's loop calls it repeatedly.

use std::path::PathBuf;
use std::time::Duration;

use dmprl_supervisor::members::{Member, Role, members};
use rustix::process::{Pid, Signal};

use super::schedule::{Fault, Schedule, Strike};
use super::timeline::Timeline;

/// Time that a strike waits for a suitable victim [us]. Afterwards it takes any victim, or is
/// skipped.
const VICTIM_WAIT_US: u64 = 20_000_000;
/// Interval between checks for a checkpoint, and number of checks before control returns to the
/// loop.
const CHECKPOINT_LOOK: Duration = Duration::from_micros(200);
const CHECKPOINT_LOOKS_MAX: usize = 100;
/// Interval between checks for a victim [us]: each one reads all of /proc.
const LOOK_US: u64 = 20_000;

/// Faults injected so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Done {
    pub(super) worker_kills: u64,
    pub(super) learner_kills: u64,
    pub(super) evaluator_kills: u64,
    pub(super) stops: u64,
    /// Learners killed during their start, and while writing a checkpoint.
    pub(super) learner_kills_in_recovery: u64,
    pub(super) learner_kills_in_checkpoint: u64,
    /// Strikes skipped for lack of a victim.
    pub(super) left_out: u64,
}

/// Progress of a strike.
#[derive(Debug, Clone, Copy)]
enum Stage {
    Pause {
        until_us: u64,
    },
    Wait {
        deadline_us: u64,
        look_us: u64,
    },
    /// The successor of a killed learner is to be killed a given time after it first appeared.
    Again {
        deaths: u64,
        seen_us: Option<u64>,
        deadline_us: u64,
    },
    Held {
        member: Member,
        until_us: u64,
    },
    /// No fault for a while after the recovery from the last one.
    Rest {
        for_us: u64,
        deadline_us: u64,
    },
}

/// Injects the faults.
pub(super) struct Nemesis {
    schedule: Schedule,
    supervisor: Pid,
    checkpoints: PathBuf,
    strike: Strike,
    stage: Stage,
    /// Incomplete checkpoints of dead learners.
    left_behind: Vec<String>,
    pub(super) done: Done,
}

impl Nemesis {
    pub(super) fn new(schedule: Schedule, supervisor: Pid, checkpoints: PathBuf) -> Self {
        let strike = Strike { pause_ms: 0, fault: Fault::Rest { for_ms: 0 } };
        let stage = Stage::Pause { until_us: 0 };
        let (left_behind, done) = (Vec::new(), Done::default());
        Self { schedule, supervisor, checkpoints, strike, stage, left_behind, done }
    }

    /// Performs the due actions.
    pub(super) fn step(&mut self, now_us: u64, timeline: &mut Timeline) -> anyhow::Result<()> {
        match self.stage {
            Stage::Pause { until_us } if now_us >= until_us => {
                let deadline_us = now_us + VICTIM_WAIT_US;
                self.stage = match self.strike.fault {
                    Fault::Rest { for_ms } => Stage::Rest { for_us: for_ms * 1_000, deadline_us },
                    _ => Stage::Wait { deadline_us, look_us: 0 },
                };
            }
            Stage::Wait { deadline_us, look_us } if now_us >= look_us => {
                let late = now_us >= deadline_us;
                if !self.strike(now_us, late, timeline)? {
                    self.stage = Stage::Wait { deadline_us, look_us: now_us + LOOK_US };
                    if late {
                        self.done.left_out += 1;
                        self.next(now_us);
                    }
                }
            }
            Stage::Again { deaths, seen_us, deadline_us } => {
                self.strike_again((deaths, seen_us), deadline_us, now_us, timeline)?;
            }
            Stage::Held { member, until_us } if now_us >= until_us => {
                self.let_go(&member, now_us, timeline);
                self.next(now_us);
            }
            Stage::Rest { for_us, deadline_us } => {
                let rested = |since: u64| now_us >= since + for_us;
                if timeline.clear_since_us().is_some_and(rested) || now_us >= deadline_us {
                    self.next(now_us);
                }
            }
            Stage::Pause { .. } | Stage::Wait { .. } | Stage::Held { .. } => {}
        }
        Ok(())
    }

    /// Stops the injection and resumes a suspended process.
    pub(super) fn relent(&mut self, now_us: u64, timeline: &mut Timeline) {
        if let Stage::Held { member, .. } = self.stage {
            self.let_go(&member, now_us, timeline);
        }
        self.stage = Stage::Pause { until_us: u64::MAX };
    }

    fn next(&mut self, now_us: u64) {
        if let Some(strike) = self.schedule.next() {
            self.stage = Stage::Pause { until_us: now_us + strike.pause_ms * 1_000 };
            self.strike = strike;
        }
    }

    /// Tries to inject the fault; returns false if it is not the right moment.
    fn strike(&mut self, now_us: u64, late: bool, timeline: &mut Timeline) -> anyhow::Result<bool> {
        let fault = self.strike.fault;
        // Two faults of the learner follow each other only if that is the fault itself. Check for
        // its absence here, before the expensive scan of /proc.
        let of_learner = matches!(
            fault,
            Fault::KillLearner
                | Fault::KillLearnerTwice { .. }
                | Fault::KillLearnerInCheckpoint
                | Fault::StopLearner { .. }
        );
        if of_learner && !late && !timeline.is_learner_back() {
            return Ok(false);
        }
        let members = members(self.supervisor)?;
        // Checked after the victim has been found, because a checkpoint takes only milliseconds.
        if fault == Fault::KillLearnerInCheckpoint && !late && !self.catch_checkpoint() {
            return Ok(false);
        }
        Ok(match fault {
            Fault::KillWorker { worker, early } => {
                let ready = early || late || timeline.is_back(worker);
                let victim = members.iter().find(|it| is_worker(it, worker)).filter(|_| ready);
                victim.is_some_and(|victim| self.kill(victim, now_us, timeline))
                    && self.over(now_us)
            }
            Fault::KillWorkers => {
                let workers = members.iter().filter(|it| matches!(it.role, Role::Worker(..)));
                let killed: u32 =
                    workers.map(|it| u32::from(self.kill(it, now_us, timeline))).sum();
                killed > 0 && self.over(now_us)
            }
            Fault::KillLearner | Fault::KillLearnerInCheckpoint => {
                let killed = self.kill_learner(&members, now_us, timeline).is_some();
                if killed && fault == Fault::KillLearnerInCheckpoint && !late {
                    // Its incomplete checkpoint is still there.
                    self.done.learner_kills_in_checkpoint += u64::from(self.checkpoint_under_way());
                }
                killed && self.over(now_us)
            }
            Fault::KillLearnerTwice { .. } => {
                let killed = self.kill_learner(&members, now_us, timeline);
                if let Some(deaths) = killed {
                    let deadline_us = now_us + VICTIM_WAIT_US;
                    self.stage = Stage::Again { deaths, seen_us: None, deadline_us };
                }
                killed.is_some()
            }
            Fault::StopWorker { worker, for_ms } => {
                let victim = members.iter().find(|it| is_worker(it, worker));
                victim.is_some_and(|victim| self.hold(victim, (now_us, for_ms), timeline))
            }
            Fault::StopLearner { for_ms } => {
                let victim = members.iter().find(|it| is_learner(it));
                victim.is_some_and(|victim| self.hold(victim, (now_us, for_ms), timeline))
            }
            Fault::KillEvaluator => {
                let victim = members.iter().find(|it| it.role == Role::Evaluator);
                victim.is_some_and(|victim| self.kill(victim, now_us, timeline))
                    && self.over(now_us)
            }
            Fault::Rest { .. } => self.over(now_us),
        })
    }

    fn over(&mut self, now_us: u64) -> bool {
        self.next(now_us);
        true
    }

    fn strike_again(
        &mut self,
        (deaths, seen_us): (u64, Option<u64>),
        deadline_us: u64,
        now_us: u64,
        timeline: &mut Timeline,
    ) -> anyhow::Result<()> {
        let Fault::KillLearnerTwice { after_ms } = self.strike.fault else {
            self.next(now_us);
            return Ok(());
        };
        let due = seen_us.is_some_and(|seen| now_us >= seen + after_ms * 1_000);
        if seen_us.is_none() || due {
            let members = members(self.supervisor)?;
            let successor = |it: &Member| matches!(it.role, Role::Learner(n) if n > deaths);
            let there = members.iter().any(successor);
            if due && there {
                let recovering = !timeline.is_learner_back();
                if self.kill_learner(&members, now_us, timeline).is_some() {
                    self.done.learner_kills_in_recovery += u64::from(recovering);
                }
                self.next(now_us);
                return Ok(());
            }
            let seen_us = seen_us.or(there.then_some(now_us));
            self.stage = Stage::Again { deaths, seen_us, deadline_us };
        }
        if now_us >= deadline_us {
            self.done.left_out += 1;
            self.next(now_us);
        }
        Ok(())
    }

    /// Waits briefly for the learner to begin a checkpoint.
    fn catch_checkpoint(&mut self) -> bool {
        // A learner that was killed while writing a checkpoint has left it behind.
        self.left_behind = self.half_written();
        (0..CHECKPOINT_LOOKS_MAX).any(|_| {
            std::thread::sleep(CHECKPOINT_LOOK);
            self.checkpoint_under_way()
        })
    }

    /// Returns true if the learner is writing a checkpoint, or was when it died.
    fn checkpoint_under_way(&self) -> bool {
        self.half_written().iter().any(|name| !self.left_behind.contains(name))
    }

    fn half_written(&self) -> Vec<String> {
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
                self.done.worker_kills += 1;
                timeline.worker_killed(index, incarnation, now_us);
            }
            Role::Learner(deaths) => {
                self.done.learner_kills += 1;
                timeline.learner_killed(deaths, now_us);
            }
            Role::Evaluator => self.done.evaluator_kills += 1,
        }
        true
    }

    /// Kills the learner; returns the number of learner deaths before it.
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

    fn hold(
        &mut self,
        victim: &Member,
        (now_us, for_ms): (u64, u64),
        timeline: &mut Timeline,
    ) -> bool {
        if !victim.signal(Signal::STOP) {
            return false;
        }
        self.done.stops += 1;
        let until_us = now_us + for_ms * 1_000;
        stopped(victim, until_us, timeline);
        self.stage = Stage::Held { member: *victim, until_us };
        true
    }

    fn let_go(&mut self, member: &Member, now_us: u64, timeline: &mut Timeline) {
        // Only this trial kills it, so it still exists.
        let _ = member.signal(Signal::CONT);
        stopped(member, now_us, timeline);
    }
}

fn is_worker(member: &Member, worker: u32) -> bool {
    matches!(member.role, Role::Worker(index, _) if index == worker)
}

fn is_learner(member: &Member) -> bool {
    matches!(member.role, Role::Learner(_))
}

/// Records that a process was suspended until `until_us`: segments sent earlier do not prove its
/// return.
fn stopped(member: &Member, until_us: u64, timeline: &mut Timeline) {
    match member.role {
        Role::Worker(index, _) => timeline.worker_stopped(index, until_us),
        Role::Learner(_) => timeline.learner_stopped(until_us),
        Role::Evaluator => {}
    }
}
