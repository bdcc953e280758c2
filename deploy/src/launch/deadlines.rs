//! The supervisor's clock: when the next deadline is, and what is done when one has passed.

use std::time::{Duration, Instant};

use anyhow::{anyhow, bail};

use super::Process;
use super::deaths::{Death, log_tail};
use super::supervisor::{Phase, Running, Supervisor};
use crate::terminal::shown;

/// The supervisor looks around at least so often.
const IDLE: Duration = Duration::from_secs(60);
/// Waking so long after its own deadline, the supervisor was not late but stood still: Ctrl-Z and
/// `fg`, or a paused container.
const STANDSTILL: Duration = Duration::from_secs(5);
/// A supervisor that is so late cannot tell a worker that hangs from one that stood still with it.
const LATE: Duration = Duration::from_secs(1);

impl Supervisor<'_> {
    pub(super) fn next_deadline(&self) -> Instant {
        let mut deadlines = vec![Instant::now() + IDLE];
        match self.phase {
            Phase::Stopping { deadline, .. } => return deadline,
            Phase::Draining { deadline } | Phase::Finishing { deadline } => {
                if self.running(self.hub()).is_some() {
                    deadlines.push(deadline);
                }
            }
            Phase::Training => {
                deadlines.extend(self.time_is_up());
                deadlines.extend(self.stalled());
                deadlines.extend(self.first_silent().map(|(at, _)| at));
            }
        }
        deadlines.extend(self.next_look_at_domain(Instant::now()));
        deadlines.extend(self.evaluations.deadline());
        let restarts = self.slots.iter().filter(|(process, _)| self.may_start(**process));
        deadlines.extend(restarts.filter_map(|(_, slot)| slot.restart_at));
        deadlines.extend(
            self.starting().map(|(process, running)| running.spawned + self.ready_limit(process)),
        );
        deadlines.into_iter().min().unwrap_or_else(Instant::now)
    }

    /// Time in which the supervisor stood still, and its children with it, counts for no deadline
    /// of theirs: each gets what it had left at `looked`, when the supervisor last looked around.
    pub(super) fn on_wake(&mut self, looked: Instant, due: Instant, now: Instant) {
        if lateness(looked, due, now) >= LATE {
            self.hear_anew(now);
        }
        let Some(lost) = stood_still(looked, due, now) else { return };
        self.advanced += lost;
        self.evaluations.postpone(lost);
        match &mut self.phase {
            Phase::Training => {}
            Phase::Draining { deadline }
            | Phase::Finishing { deadline }
            | Phase::Stopping { deadline, .. } => *deadline += lost,
        }
        for running in self.slots.values_mut().filter_map(|slot| slot.running.as_mut()) {
            running.spawned += lost;
        }
    }

    pub(super) fn on_time(&mut self, now: Instant) -> anyhow::Result<()> {
        match self.phase {
            Phase::Stopping { deadline, killed } => {
                if now >= deadline && killed {
                    self.abandon();
                } else if now >= deadline {
                    self.kill_all("not ended in time");
                }
                return Ok(());
            }
            Phase::Draining { deadline } | Phase::Finishing { deadline } => {
                self.check_learner_ends(now, deadline)?;
            }
            Phase::Training => self.check_training(now)?,
        }
        self.check_domain()?;
        self.restart_due(now)?;
        self.check_ready(now)?;
        self.check_evaluation(now);
        Ok(())
    }

    /// Counted from the session's start, but nothing to end before the learner is there.
    fn time_is_up(&self) -> Option<Instant> {
        if !self.learner_ready {
            return None;
        }
        let seconds = self.config.run.max_minutes * 60.0;
        let limit = Duration::try_from_secs_f64(seconds).ok()?;
        self.started.checked_add(limit)
    }

    /// A learner that is ready and neither steps nor updates: workers hang, or it does.
    /// One process neither steps nor updates while it evaluates.
    fn stalled(&self) -> Option<Instant> {
        let episodes =
            if self.is_one_process() { self.config.evaluation.episodes_max() } else { 0 };
        if self.hub() == Process::Relay {
            // How long the learner's host may be away is the relay's to say.
            return None;
        }
        let limit = self.limits.stall + self.limits.evaluation_of(episodes);
        self.learner_ready.then(|| self.advanced + limit)
    }

    fn check_training(&mut self, now: Instant) -> anyhow::Result<()> {
        if self.stalled().is_some_and(|deadline| now >= deadline) {
            let logs = self.launcher.run.path().join("logs");
            bail!(
                "neither a step nor an update for {:?}: workers or learner hang; see {}",
                self.limits.stall,
                shown(&logs)
            );
        }
        if self.time_is_up().is_some_and(|deadline| now >= deadline) {
            self.drain("run.max_minutes are over");
        }
        Ok(())
    }

    fn check_learner_ends(&mut self, now: Instant, deadline: Instant) -> anyhow::Result<()> {
        let Some(learner) = self.running(self.hub()).filter(|_| now >= deadline) else {
            return Ok(());
        };
        learner.child.kill();
        let limit = self.limits.drain;
        if !self.finished {
            bail!("{} did not come to its end within {limit:?}: killed it", self.hub());
        }
        self.message(&format!("{} did not exit within {limit:?}: killed it", self.hub()));
        // Its exit follows; until then no second message.
        self.phase = Phase::Finishing { deadline: now + self.limits.kill };
        Ok(())
    }

    fn restart_due(&mut self, now: Instant) -> anyhow::Result<()> {
        let due: Vec<Process> = self
            .slots
            .iter()
            .filter(|(_, slot)| slot.restart_at.is_some_and(|at| now >= at))
            .map(|(process, _)| *process)
            .filter(|process| self.may_start(*process))
            .collect();
        for process in due {
            if process == self.hub() {
                self.go_back()?;
            }
            self.spawn(process)?;
        }
        Ok(())
    }

    /// Children that are not ready and still needed: a worker is not when the learner is done.
    fn starting(&self) -> impl Iterator<Item = (Process, &Running)> {
        let needless = move |process| self.finished && matches!(process, Process::Actor(_));
        self.all_running().filter(move |(process, running)| !running.ready && !needless(*process))
    }

    /// A learner that imitates demonstrations is ready after that.
    fn ready_limit(&self, process: Process) -> Duration {
        let demonstrations = &self.config.demonstrations;
        let updates = match process {
            Process::Learner if demonstrations.are_cloned() => demonstrations.cloning_updates,
            _ => 0,
        };
        let updates = u32::try_from(updates).unwrap_or(u32::MAX);
        if let Some(upstream) = self.launcher.upstream.as_ref().filter(|_| process == self.hub()) {
            // It is ready when it has a policy, for which it waits so long by itself.
            return self.limits.ready.saturating_add(Duration::from_secs(upstream.patience_s));
        }
        self.limits.ready.saturating_add(self.limits.cloning_update.saturating_mul(updates))
    }

    fn check_ready(&mut self, now: Instant) -> anyhow::Result<()> {
        let late = self
            .starting()
            .filter(|(process, running)| now >= running.spawned + self.ready_limit(*process))
            .map(|(process, _)| process);
        for process in late.collect::<Vec<_>>() {
            let (limit, joined) = (self.ready_limit(process), self.is_joined(process));
            let Some(slot) = self.slots.get_mut(&process) else { continue };
            let Some(running) = slot.running.as_mut() else { continue };
            running.kill_for(Death::too_slow(format!("not ready within {limit:?}")));
            if slot.restarts == 0 && !joined {
                let tail = log_tail(&self.log_path(process));
                return Err(anyhow!("{process} was not ready within {limit:?}{tail}"));
            }
            // Its exit counts as one more death. Until that event, it is late only once.
            running.spawned = now;
            self.message(&format!("{process} was not ready within {limit:?}: killed it"));
        }
        Ok(())
    }

    fn check_evaluation(&mut self, now: Instant) {
        if self.evaluations.deadline().is_none_or(|deadline| now < deadline) {
            return;
        }
        // Sent again when the evaluator is back, with a deadline of its own.
        self.evaluations.send_again();
        self.message("the evaluation takes too long: killing the evaluator");
        let evaluator = self.slots.get_mut(&Process::Evaluator);
        if let Some(running) = evaluator.and_then(|slot| slot.running.as_mut()) {
            running.kill_for(Death::too_slow("an evaluation took too long".to_owned()));
        }
    }
}

/// How long a supervisor stood still that looked around at `looked`, was to wake at `due` at the
/// latest and woke at `now`; none when it was on time.
fn stood_still(looked: Instant, due: Instant, now: Instant) -> Option<Duration> {
    (lateness(looked, due, now) >= STANDSTILL).then(|| now.duration_since(looked))
}

fn lateness(looked: Instant, due: Instant, now: Instant) -> Duration {
    now.saturating_duration_since(due.max(looked))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ctrl-Z for an hour was once taken for an hour in which the learner did nothing.
    #[test]
    fn a_standstill_is_told_from_a_wait() {
        let looked = Instant::now();
        let due = looked + IDLE;
        assert_eq!(stood_still(looked, due, looked), None, "a report came at once");
        assert_eq!(stood_still(looked, due, due + Duration::from_millis(20)), None, "a timer");
        let hour = Duration::from_secs(3_600);
        assert_eq!(stood_still(looked, due, looked + hour), Some(hour));
        assert_eq!(stood_still(due, looked, due), None, "overdue and handled at once");
    }
}
