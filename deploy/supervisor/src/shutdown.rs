//! Handles the end of children and of the run: deaths, completion, interrupts and failures.

use std::process::ExitStatus;
use std::time::Duration;

use dmprl_control::Command;
use dmprl_run::{LEASE_TIMEOUT, describe};

use super::machine::Machine;
use super::observer::{AfterDeath, NotEvaluated, RunEvent};
use super::process::Process;
use super::restart_policy::{Death, EVALUATOR_RESTARTS_MAX, Restart, is_crash, is_proven, restart};
use super::state::Phase;
use super::step::{Action, Failure, ResumeAdvice};

/// Interrupts within this time count as one: `timeout` and some job schedulers signal both a
/// process and its group.
const INTERRUPT_GAP: Duration = Duration::from_millis(100);

impl Machine {
    pub(super) fn on_exit(&mut self, process: Process, status: ExitStatus) -> Result<(), Failure> {
        let Some(ended) = self.children.take(process) else { return Ok(()) };
        if let Phase::Stopping { killed, .. } = self.phase {
            if process == Process::Learner && ended.ready && !self.learner.finished {
                let cause = if killed { String::new() } else { format!(": {}", describe(status)) };
                let message = format!("learner exited without writing its last checkpoint{cause}");
                self.warn(process, message);
            }
            if self.settings.hub == Process::Relay {
                // The relay stays until the last worker has exited, to receive its last segments.
                self.send_totals();
            }
            return Ok(());
        }
        if is_proven(process, &ended, &self.settings.limits, self.now) {
            self.children.reset_restarts(process);
        }
        let death = ended.killed_for.unwrap_or_else(|| Death::of(status));
        match process {
            Process::Learner | Process::Relay if self.learner.finished => {
                if !status.success() {
                    self.warn(process, format!("{process} exited with {}", describe(status)));
                }
                self.complete_if_done();
                Ok(())
            }
            Process::Learner | Process::Relay => self.on_learner_death(status, death),
            // For instance an address in use or a missing file: a restart would not help.
            Process::Gateway if !ended.ready && status.code().is_some() => {
                Err(self.failure_of(process, &death))
            }
            Process::Gateway => {
                self.on_gateway_death(death);
                Ok(())
            }
            Process::Evaluator => self.on_evaluator_death(death),
            Process::Actor(_) if self.phase == Phase::Training => {
                self.on_worker_death(process, status, death)
            }
            Process::Actor(_) => Ok(()),
        }
    }

    /// Restarts the learner from the newest usable checkpoint, or else from the beginning. Workers
    /// wait meanwhile and keep unacknowledged segments.
    ///
    /// The successor cuts the curve back to its checkpoint and requests the missing evaluations
    /// again. An evaluation in flight would append its row after the cut, so the evaluator is
    /// killed first, and the successor starts after its exit.
    fn on_learner_death(&mut self, status: ExitStatus, death: Death) -> Result<(), Failure> {
        let hub = self.settings.hub;
        let restarts_max = self.settings.config.supervision.learner_restarts_max;
        let restartable = is_crash(status) && !self.settings.one_process;
        if !restartable || !self.restart(hub, &death, restarts_max) {
            return Err(self.failure_of(hub, &death).advice(self.resume_advice()));
        }
        self.totals.learner_restarts += 1;
        self.learner.died.get_or_insert(self.now);
        self.learner.ready = false;
        let evaluator = self.children.running(Process::Evaluator);
        let in_flight = self.evaluations.deadline().is_some();
        let may_answer =
            evaluator.is_some_and(|evaluator| in_flight || evaluator.killed_for.is_some());
        self.give_up_evaluations(&NotEvaluated::LearnerDied);
        if may_answer {
            let death = Death::too_slow("its learner died".to_owned());
            self.kill(Process::Evaluator, death);
            // The evaluator is not at fault.
            self.children.reset_restarts(Process::Evaluator);
            self.learner.waits_for_evaluator = true;
        }
        Ok(())
    }

    /// Restarts the gateway. If it is given up, the run continues with its own workers.
    fn on_gateway_death(&mut self, death: Death) {
        self.hosts.0.clear();
        let restarts = self.settings.config.supervision.learner_restarts_max;
        if self.phase == Phase::Training && !self.restart(Process::Gateway, &death, restarts) {
            let next = AfterDeath::GatewayGivenUp { restarts };
            self.notify_death(Process::Gateway, death, next);
        }
    }

    fn on_evaluator_death(&mut self, death: Death) -> Result<(), Failure> {
        self.learner.waits_for_evaluator = false;
        self.evaluations.send_again();
        let finishing = matches!(self.phase, Phase::Finishing { .. });
        if finishing && self.evaluations.outstanding() == 0 {
            self.complete_if_done();
            return Ok(());
        }
        if self.restart(Process::Evaluator, &death, EVALUATOR_RESTARTS_MAX) {
            return Ok(());
        }
        Err(self.failure_of(Process::Evaluator, &death).advice(self.resume_advice()))
    }

    fn on_worker_death(
        &mut self,
        process: Process,
        status: ExitStatus,
        death: Death,
    ) -> Result<(), Failure> {
        // No environment has worked yet: a worker that exits by itself would fail again after a
        // restart.
        if self.spec.is_none() && status.code().is_some() {
            return Err(self.failure_of(process, &death));
        }
        if self.restart(process, &death, self.settings.config.actors.restarts_max) {
            return Ok(());
        }
        let left = self.children.workers_left();
        if left == 0 {
            let failure = self.failure_of(process, &death).advice(self.resume_advice());
            return Err(failure
                .context("no worker is left: each has died more often than actors.restarts_max"));
        }
        let restarts = self.children.slots.get(&process).map_or(0, |slot| slot.restarts);
        let of = self.settings.config.actors.workers + self.joined();
        self.notify_death(process, death, AfterDeath::WorkerGivenUp { restarts, left, of });
        Ok(())
    }

    /// Handles the exit of a worker that had joined. The supervisor does not restart it.
    pub(super) fn on_gone(&mut self, process: Process) -> Result<(), Failure> {
        let ended = self.children.take(process);
        if self.phase != Phase::Training {
            return Ok(());
        }
        self.send_totals();
        let (announced, death) =
            ended.map_or((false, None), |running| (running.left, running.killed_for));
        let workers = self.children.workers();
        self.notify(RunEvent::Left { process, death, announced, workers });
        if self.children.workers_left() == 0 {
            let message = "no worker is left: all workers that joined are gone".to_owned();
            return Err(Failure::new(message).advice(self.resume_advice()));
        }
        Ok(())
    }

    /// Schedules a restart; returns false if the process has exhausted its budget.
    fn restart(&mut self, process: Process, death: &Death, restarts_max: u32) -> bool {
        let slot = self.children.slots.entry(process).or_default();
        let scheduled = restart(slot, restarts_max, &self.settings.limits, self.now);
        let Some(Restart { number, back_off }) = scheduled else { return false };
        self.totals.worker_restarts += u64::from(process.is_worker());
        let next = AfterDeath::Restart { restart: number, restarts_max, back_off };
        self.notify_death(process, death.clone(), next);
        true
    }

    fn notify_death(&mut self, process: Process, death: Death, next: AfterDeath) {
        let log = self.log_path(process);
        self.notify(RunEvent::ChildDied { process, death, log, next });
    }

    fn failure_of(&self, process: Process, death: &Death) -> Failure {
        let Death { verb, cause } = death;
        Failure::new(format!("{process} {verb}: {cause}")).log(process)
    }

    pub(super) fn resume_advice(&self) -> ResumeAdvice {
        let learner = self.children.running(Process::Learner);
        match learner.is_some_and(|running| running.ready) {
            true => ResumeAdvice::Always,
            false => ResumeAdvice::IfCheckpoint,
        }
    }

    /// Ends the run if `result` is an error.
    pub(super) fn fail_on_error(&mut self, result: Result<(), Failure>) {
        if let Err(failure) = result {
            self.fail(failure);
        }
    }

    /// Ends the run because it cannot continue. The learner writes a checkpoint if it is running.
    fn fail(&mut self, failure: Failure) {
        if self.failure.is_some() || self.interrupts > 0 {
            self.actions.push(Action::NotifyFailure(failure));
            return;
        }
        self.failure = Some(failure);
        let learner = self.children.running(self.settings.hub);
        let limits = &self.settings.limits;
        let ready = learner.is_some_and(|running| running.ready);
        self.stop(if ready { limits.drain } else { limits.stop });
    }

    /// Asks the learner to finish before its last step.
    pub(super) fn drain(&mut self, reason: String) {
        if self.phase == Phase::Training {
            self.notify(RunEvent::Draining { reason });
            self.phase = Phase::Draining { deadline: self.now + self.settings.limits.drain };
            self.send(self.settings.hub, Command::Finish);
        }
    }

    /// The learner has written its last checkpoint: workers stop.
    pub(super) fn on_finished(&mut self) {
        self.learner.finished = true;
        if !matches!(self.phase, Phase::Training | Phase::Draining { .. }) {
            return;
        }
        self.phase = Phase::Finishing { deadline: self.now + self.settings.limits.drain };
        self.children.cancel_restarts(Process::is_worker);
        for process in self.children.names().into_iter().filter(|process| process.is_worker()) {
            self.send(process, Command::Stop);
        }
        // The gateway tells the other hosts that the run is over, and exits.
        self.send(Process::Gateway, Command::Finish);
    }

    /// Stops all processes once the learner has exited and all evaluations are answered.
    pub(super) fn complete_if_done(&mut self) {
        let finishing = matches!(self.phase, Phase::Finishing { .. });
        let learner_gone = self.children.running(self.settings.hub).is_none();
        if finishing && learner_gone && self.evaluations.outstanding() == 0 {
            self.stop(self.settings.limits.stop);
        }
    }

    pub(super) fn on_interrupt(&mut self) {
        let since = self.interrupted_at.map(|at| self.now.duration_since(at));
        if since.is_some_and(|since| since < INTERRUPT_GAP) {
            return;
        }
        self.interrupted_at = Some(self.now);
        self.interrupts += 1;
        match self.interrupts {
            1 => {
                let before_the_end = match self.settings.hub {
                    Process::Relay => "delivering the workers' segments",
                    _ if self.learner.finished => "skipping evaluations",
                    _ => "writing a checkpoint",
                };
                self.notify(RunEvent::Interrupted { before_the_end });
                self.stop(self.settings.limits.stop);
            }
            2 => self.kill_all("interrupted twice"),
            _ => {}
        }
    }

    /// Ends the run at once, without a checkpoint: it would be written into another one's run.
    pub(super) fn on_lock_lost(&mut self, holder: &str) {
        let message = format!(
            "{holder} has taken the run over, because this process did not renew its lease for \
             {} s; was it suspended, or cut off from the file system?",
            LEASE_TIMEOUT.as_secs()
        );
        self.failure.get_or_insert_with(|| Failure::new(message));
        self.give_up_evaluations(&NotEvaluated::Stopping);
        self.children.cancel_restarts(|_| true);
        self.kill_all("the run was taken over");
    }

    /// Asks every child to exit within `limit`. If a stop is in progress, this can shorten its
    /// limit but not extend it.
    fn stop(&mut self, limit: Duration) {
        let deadline = self.now + limit;
        if let Phase::Stopping { deadline: before, killed } = self.phase {
            self.phase = Phase::Stopping { deadline: deadline.min(before), killed };
            return;
        }
        self.give_up_evaluations(&NotEvaluated::Stopping);
        self.children.cancel_restarts(|_| true);
        for process in self.children.names() {
            self.send(process, Command::Stop);
        }
        self.phase = Phase::Stopping { deadline, killed: false };
    }

    /// Sends SIGKILL to all running children.
    pub(super) fn kill_all(&mut self, reason: &'static str) {
        let processes = self.children.names();
        let kills = processes.iter().map(|process| Action::Kill(*process));
        self.actions.extend(kills);
        if !processes.is_empty() {
            self.notify(RunEvent::Killed { processes, reason });
        }
        let deadline = self.now + self.settings.limits.kill;
        self.phase = Phase::Stopping { deadline, killed: true };
    }

    /// Gives up because a process survived SIGKILL, which happens only after a fault of the kernel
    /// or a device.
    pub(super) fn abandon(&mut self) {
        let names: Vec<String> = self.children.names().iter().map(ToString::to_string).collect();
        let limit = self.settings.limits.kill;
        let message = format!("{} did not exit within {limit:?} of SIGKILL", names.join(", "));
        self.failure = Some(Failure::new(message));
        self.abandoned = true;
    }
}
