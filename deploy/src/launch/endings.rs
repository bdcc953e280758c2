//! How a run ends: regularly, by an interrupt, by a failure.

use std::time::{Duration, Instant};

use anyhow::{Error, anyhow};

use super::Process;
use super::supervisor::{Phase, Supervisor};
use crate::control::Command;

/// Two interrupts so close together count as one.
const INTERRUPT_GAP: Duration = Duration::from_millis(100);

impl Supervisor<'_> {
    /// Turns an error into the end of the run.
    pub(super) fn check(&mut self, result: anyhow::Result<()>) {
        if let Err(error) = result {
            self.fail(error);
        }
    }

    /// Ends the run because it cannot go on; the learner, if it lives, writes a checkpoint.
    fn fail(&mut self, error: Error) {
        if self.failure.is_some() || self.interrupts > 0 {
            self.message(&format!("while stopping: {error:#}"));
            return;
        }
        self.failure = Some(error);
        let learner = self.running(self.hub()).is_some_and(|running| running.ready);
        self.stop(if learner { self.limits.drain } else { self.limits.stop });
    }

    /// Asks the learner to come to its end before its time.
    pub(super) fn drain(&mut self, reason: &str) {
        if self.phase == Phase::Training {
            self.message(&format!("{reason}: coming to an end"));
            self.phase = Phase::Draining { deadline: Instant::now() + self.limits.drain };
            self.send(self.hub(), Command::Finish);
        }
    }

    /// The learner has written its last checkpoint; workers have nobody to step for.
    pub(super) fn on_finished(&mut self) {
        self.finished = true;
        if matches!(self.phase, Phase::Training | Phase::Draining { .. }) {
            self.phase = Phase::Finishing { deadline: Instant::now() + self.limits.drain };
            let actors = self.slots.iter_mut();
            for (_, slot) in actors.filter(|(process, _)| matches!(process, Process::Actor(_))) {
                slot.restart_at = None;
                // One that takes no command is killed when everything stops.
                let _ = slot.running.as_ref().map(|running| running.child.send(Command::Stop));
            }
            // It tells the other hosts that the run is over, and ends.
            self.send(Process::Gateway, Command::Finish);
        }
    }

    /// The regular end: the learner is gone, nothing is left to evaluate.
    pub(super) fn complete_if_done(&mut self) {
        let finishing = matches!(self.phase, Phase::Finishing { .. });
        let learner_gone = self.running(self.hub()).is_none();
        if finishing && learner_gone && self.evaluations.outstanding() == 0 {
            self.stop(self.limits.stop);
        }
    }

    pub(super) fn on_interrupt(&mut self) {
        // `timeout` and some job schedulers send a signal to a process and to its group at once:
        // that is one wish, not two.
        let now = Instant::now();
        if self.interrupted_at.is_some_and(|at| now.duration_since(at) < INTERRUPT_GAP) {
            return;
        }
        self.interrupted_at = Some(now);
        self.interrupts += 1;
        match self.interrupts {
            1 => {
                let what = match self.hub() {
                    Process::Relay => "handing over what the workers have sent",
                    _ if self.finished => "skipping evaluations",
                    _ => "writing a checkpoint",
                };
                self.message(&format!("interrupted: {what} (once more: stop at once)"));
                self.stop(self.limits.stop);
            }
            2 => self.kill_all("interrupted twice"),
            _ => {}
        }
    }

    /// Asks every child to end within `limit`.
    fn stop(&mut self, limit: Duration) {
        let mut deadline = Instant::now() + limit;
        let mut killed = false;
        if let Phase::Stopping { deadline: before, killed: already } = self.phase {
            // Already asked; an interrupt makes it more urgent, nothing makes it less.
            deadline = deadline.min(before);
            killed = already;
        } else {
            self.evaluations.clear();
            self.slots.values_mut().for_each(|slot| slot.restart_at = None);
            for (_, running) in self.all_running() {
                // One that takes no command is killed at the deadline.
                let _ = running.child.send(Command::Stop);
            }
        }
        self.phase = Phase::Stopping { deadline, killed };
    }

    /// SIGKILL to whatever still runs.
    pub(super) fn kill_all(&mut self, reason: &str) {
        let names: Vec<String> =
            self.all_running().map(|(process, _)| process.to_string()).collect();
        if !names.is_empty() {
            self.message(&format!("{reason}: killed {}", names.join(", ")));
        }
        self.all_running().for_each(|(_, running)| running.child.kill());
        self.phase = Phase::Stopping { deadline: Instant::now() + self.limits.kill, killed: true };
    }

    /// Not even SIGKILL helped, which only a fault of kernel or device explains.
    pub(super) fn abandon(&mut self) {
        let names: Vec<String> =
            self.all_running().map(|(process, _)| process.to_string()).collect();
        let limit = self.limits.kill;
        self.failure = Some(anyhow!("{} did not end {limit:?} after SIGKILL", names.join(", ")));
        self.abandoned = true;
    }
}
