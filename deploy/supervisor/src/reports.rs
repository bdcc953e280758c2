//! Handles reports of children and requests to join.

use dmprl_control::{Command, EvaluationRequest, EvaluationRow, Greeting, Progress, Report};
use dmprl_shared::spec::EnvSpec;

use super::launcher::INCARNATIONS_PER_SESSION;
use super::machine::Machine;
use super::observer::{NotEvaluated, RunEvent};
use super::process::Process;
use super::restart_policy::Death;
use super::state::{Milestone, Phase};
use super::step::{Action, Admission, Failure};

/// Maximum number of lines that are shown although they are not reports. Further ones are counted.
const GARBAGE_SHOWN_MAX: u32 = 3;
/// Maximum number of characters of such a line.
const GARBAGE_CHARS: usize = 200;
/// Warning about an environment without a time limit.
const NO_LIMIT: &str = "the environment has no time limit: an episode ends only when the \
    environment ends it, and in an evaluation after 10,000 steps. If episodes do not end, add a \
    limit, such as: --env-kwargs max_episode_steps=500";

impl Machine {
    pub(super) fn on_garbage(&mut self, process: Process, line: &str) {
        self.garbage += 1;
        if self.garbage <= GARBAGE_SHOWN_MAX {
            let line: String = line.escape_debug().take(GARBAGE_CHARS).collect();
            self.warn(process, format!("{process} wrote a line that is not a report: {line}"));
        }
    }

    /// Handles a report. An invalid report ends the run, unless it is from a worker that joined:
    /// then only that worker is killed.
    pub(super) fn on_report(&mut self, process: Process, report: Report) -> Result<(), Failure> {
        match self.handle_report(process, report) {
            Err(failure) if self.is_joined(process) => {
                self.kill(process, Death::rejected(format!("{:#}", failure.error)));
                Ok(())
            }
            handled => handled,
        }
    }

    fn handle_report(&mut self, process: Process, report: Report) -> Result<(), Failure> {
        let counts =
            matches!(report, Report::Sent(_) | Report::EnvFailures { .. } | Report::EnvHung { .. });
        if self.children.running(process).is_none() && !counts {
            // The process has exited, so only its counts still matter.
            return Ok(());
        }
        self.heard(process, &report);
        match report {
            Report::EnvironmentReady { spec } => return self.on_environment(process, spec),
            Report::LearnerReady => return self.on_learner_ready(process),
            Report::FirstSegment => self.on_first_segment(),
            Report::Progress(progress) => self.on_progress(progress),
            Report::Evaluate(request) => self.on_evaluate(request),
            Report::Evaluated(row) => return self.on_evaluated(process, row),
            Report::NotEvaluated { policy_version, reason } => {
                return self.on_not_evaluated(process, policy_version, reason);
            }
            Report::EnvFailures { count, last } => self.on_env_failures(process, count, last),
            Report::Sent(sent) => {
                self.totals.sent += sent;
                if let Some(slot) = self.children.slots.get_mut(&process) {
                    slot.sent += sent;
                }
                if sent.sent > 0 {
                    self.children.worked(process, self.now);
                }
            }
            // Observers and video processes are not supervised here.
            Report::Alive { .. } | Report::Observed { .. } | Report::Filmed { .. } => {}
            Report::Hosts(hosts) => {
                // The gateway's first report means that its endpoints are open.
                self.set_ready(process);
                self.hosts.0 = hosts;
                self.children.worked(process, self.now);
                self.send_totals();
            }
            Report::Left => {
                if let Some(running) = self.children.running_mut(process) {
                    running.left = true;
                }
            }
            Report::EnvHung { message } => {
                // The process exits after this report.
                self.totals.env_failures = self.totals.env_failures.saturating_add(1);
                self.warn(process, format!("{process}: {message}"));
                self.send_totals();
            }
            Report::Checkpoint { name, env_steps } => {
                self.learner.checkpointed = true;
                self.children.worked(process, self.now);
                self.notify(RunEvent::Checkpoint { name, env_steps });
            }
            Report::Finished => {
                if process != self.settings.hub || !self.learner.ready {
                    let message = format!("{process} reported `finished` before `learner_ready`");
                    return Err(Failure::new(message));
                }
                self.on_finished();
            }
            Report::Warning { message } => self.warn(process, format!("{process}: {message}")),
        }
        Ok(())
    }

    fn heard(&mut self, process: Process, report: &Report) {
        let now = self.now;
        if let Some(running) = self.children.running_mut(process) {
            running.heard = now;
            if let Report::Alive { doing, kept } = report {
                running.activity = Some(*doing);
                running.kept = *kept;
            }
        }
    }

    fn on_environment(&mut self, process: Process, spec: EnvSpec) -> Result<(), Failure> {
        let difference = self.spec.as_ref().and_then(|known| known.difference(&spec));
        if let Some(difference) = difference {
            return Err(Failure::new(format!(
                "the environment of {process} differs from the run's: {difference}. Use the \
                 environment's version that the run began with, or start a new run"
            )));
        }
        match &self.spec {
            None => {
                self.actions.push(Action::WriteSpec(spec.clone()));
                if spec.episode_steps == 0 {
                    self.notify(RunEvent::Warning { process: None, message: NO_LIMIT.into() });
                }
                self.spec = Some(spec);
            }
            // A run of an older version that is resumed has no goal rule yet.
            Some(known) if known.goal_rule.is_none() && spec.goal_rule.is_some() => {
                self.actions.push(Action::WriteSpec(spec.clone()));
                self.spec = Some(spec);
            }
            Some(_) => {}
        }
        let hub = self.settings.hub;
        if process == hub || matches!(self.phase, Phase::Stopping { .. }) {
            return Ok(());
        }
        self.set_ready(process);
        match process {
            Process::Evaluator => self.send_evaluation(),
            _ if self.learner.ready => self.attach(process),
            _ if !self.children.was_started(hub) => self.start(hub),
            _ => {}
        }
        Ok(())
    }

    fn on_learner_ready(&mut self, process: Process) -> Result<(), Failure> {
        let hub = self.settings.hub;
        if process != hub {
            return Err(Failure::new(format!("{process} reported `learner_ready`")));
        }
        self.set_ready(process);
        self.learner.ready = true;
        if self.totals.learner_restarts > 0 {
            self.actions.push(Action::Rewind);
        }
        self.advanced = self.now;
        self.send_totals();
        if matches!(self.phase, Phase::Draining { .. }) {
            // Its predecessor was asked to finish, but died.
            self.send(hub, Command::Finish);
        }
        if self.settings.one_process || self.phase != Phase::Training {
            return Ok(());
        }
        let waiting = self
            .children
            .all_running()
            .filter(|(process, running)| process.is_worker() && running.ready && !running.attached);
        let waiting: Vec<Process> = waiting.map(|(process, _)| process).collect();
        waiting.into_iter().for_each(|process| self.attach(process));
        if hub == Process::Relay {
            return Ok(());
        }
        if !self.children.was_started(Process::Evaluator) {
            self.start(Process::Evaluator);
        }
        if self.settings.config.bridge.is_open() && !self.children.was_started(Process::Gateway) {
            self.start(Process::Gateway);
        }
        Ok(())
    }

    fn on_first_segment(&mut self) {
        let died = self.learner.died.take();
        let after = self.now.duration_since(died.unwrap_or(self.started));
        self.notify(RunEvent::FirstStep { after, is_successor: died.is_some() });
    }

    fn set_ready(&mut self, process: Process) {
        if let Some(running) = self.children.running_mut(process) {
            running.ready = true;
        }
    }

    fn attach(&mut self, process: Process) {
        self.actions.push(Action::Attach(process));
        if let Some(running) = self.children.running_mut(process) {
            running.attached = true;
        }
        if self.is_joined(process) {
            self.notify(RunEvent::Joined { process, workers: self.children.workers() });
        }
        self.send_totals();
    }

    fn on_progress(&mut self, progress: Progress) {
        let marks = |progress: &Progress| (progress.env_steps, progress.updates);
        if self.last.as_ref().is_none_or(|last| marks(&last.progress) != marks(&progress)) {
            self.advanced = self.now;
        }
        self.learner.checkpointed = false;
        self.send_totals();
        self.notify(RunEvent::Progress { progress: progress.clone(), processes: Vec::new() });
        let milestone = |progress| Some(Milestone { at: self.now, progress });
        if self.first.is_none() {
            self.first = milestone(progress.clone());
        }
        self.last = milestone(progress);
    }

    /// Shows the first failure, and the latest one whenever the count has doubled. The process's
    /// log has all of them.
    fn on_env_failures(&mut self, process: Process, count: u64, last: String) {
        if self.totals.add_env_failures(count) {
            let log = (!self.is_joined(process)).then(|| self.log_path(process));
            let count = self.totals.env_failures;
            self.notify(RunEvent::EnvFailure { process, count, last, log });
        }
        self.send_totals();
    }

    fn on_evaluate(&mut self, request: EvaluationRequest) {
        if matches!(self.phase, Phase::Stopping { .. }) {
            return self.give_up_evaluation(&request, NotEvaluated::Stopping);
        }
        if let Some(skipped) = self.evaluations.push(request) {
            let env_steps = skipped.env_steps;
            self.give_up_evaluation(&skipped, NotEvaluated::TooFarBehind { env_steps });
        }
        self.send_evaluation();
    }

    fn give_up_evaluation(&mut self, request: &EvaluationRequest, reason: NotEvaluated) {
        self.notify(RunEvent::NotEvaluated { policy_version: request.policy_version, reason });
    }

    /// Gives up all evaluations that are waiting or in flight.
    pub(super) fn give_up_evaluations(&mut self, reason: &NotEvaluated) {
        for request in self.evaluations.clear() {
            self.give_up_evaluation(&request, reason.clone());
        }
    }

    /// Sends the next request, if the evaluator is ready and idle.
    fn send_evaluation(&mut self) {
        let evaluator = self.children.running(Process::Evaluator);
        if !evaluator.is_some_and(|running| running.ready && running.killed_for.is_none()) {
            return;
        }
        if let Some(request) = self.evaluations.start(self.now) {
            self.send(Process::Evaluator, Command::Evaluate(request));
        }
    }

    fn on_evaluated(&mut self, process: Process, row: EvaluationRow) -> Result<(), Failure> {
        if self.expects_no_answer() {
            return Ok(());
        }
        self.on_answer(process, row.policy_version)?;
        let run = &self.settings.config.run;
        let reached = if row.return_mean >= run.until_return {
            Some(format!("the return has reached {}", run.until_return))
        } else if row.success_rate.is_some_and(|rate| rate >= run.until_success) {
            Some(format!("the success rate has reached {}", run.until_success))
        } else {
            None
        };
        // `Supervisor::notify` sets `is_best`, as it knows the best row of the run.
        self.notify(RunEvent::Evaluated { row: row.clone(), is_best: false });
        self.last_row = Some(row);
        if let Some(reason) = reached {
            self.drain(reason);
        }
        self.complete_if_done();
        Ok(())
    }

    /// Handles a failed evaluation. The run continues without this point of its curve.
    fn on_not_evaluated(
        &mut self,
        process: Process,
        policy_version: u64,
        reason: String,
    ) -> Result<(), Failure> {
        if self.expects_no_answer() {
            return Ok(());
        }
        self.on_answer(process, policy_version)?;
        let reason = NotEvaluated::Failed { reason, log: self.log_path(process) };
        self.notify(RunEvent::NotEvaluated { policy_version, reason });
        self.complete_if_done();
        Ok(())
    }

    /// Whether an answer belongs to a request that was given up, because the run stops or because
    /// the learner died. Its successor requests the evaluation again.
    fn expects_no_answer(&self) -> bool {
        self.learner.waits_for_evaluator || matches!(self.phase, Phase::Stopping { .. })
    }

    fn on_answer(&mut self, process: Process, policy_version: u64) -> Result<(), Failure> {
        if self.settings.one_process {
            return Ok(());
        }
        let killed = self.children.running(process).is_some_and(|it| it.killed_for.is_some());
        if killed && self.evaluations.finish_late(policy_version) {
            return Ok(());
        }
        if process != Process::Evaluator || !self.evaluations.finish(policy_version) {
            return Err(Failure::new(format!(
                "{process} evaluated policy {policy_version} without a request"
            )));
        }
        // Each answer resets the evaluator's restart budget.
        self.children.reset_restarts(Process::Evaluator);
        self.send_evaluation();
        Ok(())
    }

    /// Whether the process is a worker that joined. Such workers have the indices after the run's
    /// own workers.
    pub(super) fn is_joined(&self, process: Process) -> bool {
        let workers = self.settings.config.actors.workers;
        matches!(process, Process::Actor(index) if index as usize >= workers)
    }

    /// Number of running workers that joined.
    pub(super) fn joined(&self) -> usize {
        self.children.all_running().filter(|(process, _)| self.is_joined(*process)).count()
    }

    /// Admits a worker, or rejects it with a reason.
    pub(super) fn on_join_request(&mut self, request: u64, id: i32, speaks: &Greeting) {
        match self.free_place(speaks) {
            Ok(index) => {
                let process = Process::Actor(index);
                let start = self.children.start(process, self.now);
                let workers = self.children.workers() + 1;
                self.actions.push(Action::Admit(Admission { request, index, start, workers }));
                self.notify(RunEvent::ChildStarted { process, start });
            }
            Err(reason) => {
                let message = format!("process {id} was not admitted to the run: {reason}");
                self.notify(RunEvent::Warning { process: None, message });
                self.actions.push(Action::Refuse { request, reason });
            }
        }
    }

    fn free_place(&self, speaks: &Greeting) -> Result<u32, String> {
        if *speaks != Greeting::this() {
            return Err(format!("expected {}, got {speaks}", Greeting::this()));
        }
        if self.phase != Phase::Training {
            return Err("the run is ending".to_owned());
        }
        if !self.children.was_started(self.settings.hub) {
            return Err("the run is still starting; try again in a moment".to_owned());
        }
        let actors = &self.settings.config.actors;
        let free = |index: &u32| {
            let slot = self.children.slots.get(&Process::Actor(*index));
            slot.is_none_or(|slot| slot.running.is_none() && slot.starts < INCARNATIONS_PER_SESSION)
        };
        // The configuration limits both to about a thousand.
        let mut places = actors.workers as u32..actors.places() as u32;
        let count = places.len();
        places.find(free).ok_or_else(|| {
            format!(
                "{count} of {count} places for workers that join are taken (actors.joined_max); \
                 try again when a worker has left"
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;
    use crate::machine::tests::machine;
    use crate::simulation::fakes;
    use crate::step::Event;

    #[test]
    fn an_environment_without_a_time_limit_is_noted_once() {
        let folder = tempfile::tempdir().unwrap();
        let now = Instant::now();
        let warnings = |episode_steps| {
            let run = folder.path().join(format!("{episode_steps}"));
            let mut machine = machine(&run, now);
            let mut warnings = 0;
            for index in 0..2 {
                machine.children.start(Process::Actor(index), now);
                let spec = EnvSpec { episode_steps, ..fakes::spec() };
                let report = Report::EnvironmentReady { spec };
                let actions = machine.step(Event::Report(Process::Actor(index), report), now);
                let is_warning = |action: &&Action| {
                    matches!(action, Action::Notify(RunEvent::Warning { message, .. })
                        if message == NO_LIMIT)
                };
                warnings += actions.iter().filter(is_warning).count();
            }
            warnings
        };
        assert_eq!((warnings(0), warnings(50)), (1, 0));
    }
}
