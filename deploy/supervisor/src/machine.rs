//! The supervisor's decisions: a pure state machine.
//!
//! [`Machine::step`] maps state, event and time to actions. It reads no clock and no file, and
//! starts nothing: the loop in `supervisor.rs` performs the actions and passes events to it.
//! `simulation/` tests it with deaths, hangs, late messages and interrupts.
//!
//! This file has the state, the start of a session and the deadlines. `reports.rs` handles reports
//! of children, and `shutdown.rs` the end of children and of the run.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::anyhow;
use dmprl_control::{Command, EvaluationRow, WorkersNow};
use dmprl_run::format::shown;
use dmprl_shared::spec::EnvSpec;

use super::children::{Children, Running};
use super::evaluations::EvaluationQueue;
use super::hosts::Hosts;
use super::observer::RunEvent;
use super::process::Process;
use super::restart_policy::Death;
use super::state::{Learner, Milestone, Phase, Settings};
use super::step::{Action, Event, Failure, Successor};
use super::totals::Totals;

/// Maximum time between two turns.
const IDLE: Duration = Duration::from_secs(60);

/// The state of a session.
#[derive(Debug)]
pub(super) struct Machine {
    pub(super) settings: Settings,
    pub(super) phase: Phase,
    pub(super) children: Children,
    pub(super) evaluations: EvaluationQueue,
    pub(super) hosts: Hosts,
    /// Counts of this session.
    pub(super) totals: Totals,
    pub(super) learner: Learner,
    pub(super) spec: Option<EnvSpec>,
    pub(super) interrupts: u32,
    pub(super) interrupted_at: Option<Instant>,
    pub(super) failure: Option<Failure>,
    /// A process survived SIGKILL.
    pub(super) abandoned: bool,
    /// Number of lines that were not reports.
    pub(super) garbage: u32,
    pub(super) started: Instant,
    /// When steps or updates last increased.
    pub(super) advanced: Instant,
    pub(super) first: Option<Milestone>,
    pub(super) last: Option<Milestone>,
    pub(super) last_row: Option<EvaluationRow>,
    /// Time of the current step.
    pub(super) now: Instant,
    /// Actions of the current step.
    pub(super) actions: Vec<Action>,
}

impl Machine {
    /// Creates a session, which begins with [`Event::Begin`].
    pub(super) fn new(settings: Settings, now: Instant) -> Self {
        let limit = settings.limits.evaluation_of(settings.config.evaluation.episodes_max());
        Self {
            phase: Phase::Training,
            children: Children::default(),
            evaluations: EvaluationQueue::new(limit),
            hosts: Hosts::default(),
            totals: Totals::default(),
            learner: Learner::default(),
            spec: settings.spec.clone(),
            interrupts: 0,
            interrupted_at: None,
            failure: None,
            abandoned: false,
            garbage: 0,
            started: now,
            advanced: now,
            first: None,
            last: None,
            last_row: None,
            now,
            actions: Vec::new(),
            settings,
        }
    }

    /// Handles an event, then everything that is due at `now`. The caller must perform the returned
    /// actions in order.
    pub(super) fn step(&mut self, event: Event, now: Instant) -> Vec<Action> {
        self.now = now;
        let handled = self.handle(event);
        self.fail_on_error(handled);
        let handled = self.on_time();
        self.fail_on_error(handled);
        std::mem::take(&mut self.actions)
    }

    fn handle(&mut self, event: Event) -> Result<(), Failure> {
        match event {
            Event::Begin => self.begin(),
            Event::Report(process, report) => return self.on_report(process, report),
            Event::Garbage(process, line) => self.on_garbage(process, &line),
            Event::Exited(process, status) => return self.on_exit(process, status),
            Event::Gone(process) => return self.on_gone(process),
            Event::JoinRequested { request, id, speaks } => {
                self.on_join_request(request, id, &speaks);
            }
            Event::StartFailed(process, error) => {
                self.children.take(process);
                if !self.is_joined(process) {
                    return Err(error.into());
                }
                self.warn(process, format!("{process} could not join: {error:#}"));
            }
            Event::ActionFailed(error) => return Err(error.into()),
            Event::DomainLost(path) => {
                let message = format!(
                    "the run's shared memory {} was removed; do not clear /dev/shm while a run is \
                     active",
                    shown(&path)
                );
                return Err(Failure::new(message).advice(self.resume_advice()));
            }
            Event::LockLost(holder) => self.on_lock_lost(&holder),
            Event::Interrupt => self.on_interrupt(),
            Event::Late => self.children.reset_silence(self.now),
            Event::Suspended(lost) => self.postpone(lost),
            Event::Tick { all_heard: true } => self.check_heartbeats(),
            Event::Tick { all_heard: false } => {}
        }
        Ok(())
    }

    /// Starts workers, and the learner if the environment is known: the learner needs it.
    fn begin(&mut self) {
        if self.settings.one_process || self.spec.is_some() {
            self.start(self.settings.hub);
        }
        if self.settings.one_process {
            return;
        }
        if self.settings.config.actors.joined_max > 0 {
            self.actions.push(Action::Listen);
        }
        // The configuration limits it to about a thousand.
        for index in 0..self.settings.config.actors.workers as u32 {
            self.start(Process::Actor(index));
        }
    }

    pub(super) fn start(&mut self, process: Process) {
        let start = self.children.start(process, self.now);
        let is_successor = process == Process::Learner && start > 0;
        let earlier = self.settings.earlier.learner_restarts;
        let successor =
            is_successor.then(|| Successor { restarts: earlier + self.totals.learner_restarts });
        self.actions.push(Action::Start { process, start, successor });
        self.notify(RunEvent::ChildStarted { process, start });
    }

    pub(super) fn notify(&mut self, event: RunEvent) {
        self.actions.push(Action::Notify(event));
    }

    pub(super) fn warn(&mut self, process: Process, message: String) {
        self.notify(RunEvent::Warning { process: Some(process), message });
    }

    pub(super) fn send(&mut self, process: Process, command: Command) {
        if self.children.running(process).is_some() {
            self.actions.push(Action::Send(process, command));
        }
    }

    pub(super) fn kill(&mut self, process: Process, death: Death) {
        let ends_by = self.now + self.settings.limits.killed;
        if let Some(running) = self.children.running_mut(process) {
            running.killed_for = Some(death);
            running.ends_by.get_or_insert(ends_by);
            self.actions.push(Action::Kill(process));
        }
    }

    pub(super) fn log_path(&self, process: Process) -> PathBuf {
        self.settings.run.log_path(&process.to_string())
    }

    /// Sends the counts of the whole run to the learner, for metrics and checkpoints. Each message
    /// has all counts, so a lost message does no harm.
    pub(super) fn send_totals(&mut self) {
        if self.settings.one_process {
            return;
        }
        let (hub, totals) = (self.settings.hub, self.settings.earlier.plus(&self.totals));
        self.send(hub, Command::EnvFailures { total: totals.env_failures });
        self.send(hub, Command::Sent(totals.sent));
        let workers = WorkersNow {
            count: self.children.workers() as u64 + self.hosts.workers(),
            restarts: totals.worker_restarts + self.hosts.restarts(),
            queued_segments: self.children.kept() + self.hosts.kept(),
        };
        self.send(hub, Command::Workers(workers));
    }

    /// Whether the session is over: all processes have exited, or one cannot be killed.
    pub(super) fn is_over(&self) -> bool {
        let stopping = matches!(self.phase, Phase::Stopping { .. });
        stopping && (self.abandoned || self.children.all_running().next().is_none())
    }

    /// Whether processes may still need the shared-memory directory in order to attach.
    pub(super) fn needs_domain(&self) -> bool {
        !self.settings.one_process && matches!(self.phase, Phase::Training | Phase::Draining { .. })
    }

    /// Returns when the next step is due if no event arrives.
    pub(super) fn next_deadline(&self, now: Instant) -> Instant {
        let mut deadlines = vec![now + IDLE];
        match self.phase {
            Phase::Stopping { deadline, .. } => return deadline,
            Phase::Draining { deadline } | Phase::Finishing { deadline } => {
                let hub = self.children.running(self.settings.hub);
                if hub.is_some_and(|hub| hub.killed_for.is_none()) {
                    deadlines.push(deadline);
                }
            }
            Phase::Training => {
                deadlines.extend(self.time_is_up());
                deadlines.extend(self.stalled());
                deadlines.extend(self.first_silent().map(|(at, _)| at));
            }
        }
        deadlines.extend(self.evaluations.deadline());
        deadlines.extend(self.children.all_running().filter_map(|(_, running)| running.ends_by));
        let slots = self.children.slots.iter().filter(|(process, _)| self.may_start(**process));
        deadlines.extend(slots.filter_map(|(_, slot)| slot.restart_at));
        deadlines.extend(
            self.starting().map(|(process, running)| running.spawned + self.ready_limit(process)),
        );
        deadlines.into_iter().min().unwrap_or(now)
    }

    /// Extends all deadlines: time in which the supervisor and its children were suspended together
    /// does not count.
    fn postpone(&mut self, lost: Duration) {
        self.children.reset_silence(self.now);
        self.advanced += lost;
        self.evaluations.postpone(lost);
        match &mut self.phase {
            Phase::Training => {}
            Phase::Draining { deadline }
            | Phase::Finishing { deadline }
            | Phase::Stopping { deadline, .. } => *deadline += lost,
        }
        for running in self.children.each_running() {
            running.spawned += lost;
            running.ends_by = running.ends_by.map(|ends_by| ends_by + lost);
        }
    }

    /// Does what is due.
    fn on_time(&mut self) -> Result<(), Failure> {
        match self.phase {
            Phase::Stopping { deadline, killed } => {
                if self.now >= deadline && killed {
                    self.abandon();
                } else if self.now >= deadline {
                    self.kill_all("time limit exceeded");
                }
                return Ok(());
            }
            Phase::Draining { deadline } | Phase::Finishing { deadline } => {
                self.check_learner_ends(deadline)?;
            }
            Phase::Training => self.check_training()?,
        }
        self.restart_due();
        self.check_killed()?;
        self.check_ready()?;
        self.check_evaluation();
        Ok(())
    }

    /// Returns the end of `run.max_minutes`, counted from the start of the session; `None` before
    /// the learner is ready.
    fn time_is_up(&self) -> Option<Instant> {
        if !self.learner.ready {
            return None;
        }
        let limit = Duration::try_from_secs_f64(self.settings.config.run.max_minutes * 60.0);
        self.started.checked_add(limit.ok()?)
    }

    /// Returns when a ready learner counts as stuck because steps and updates do not advance. In a
    /// one-process run they do not advance during an evaluation. On a host without a learner, the
    /// relay has its own limit.
    fn stalled(&self) -> Option<Instant> {
        let Settings { config, limits, .. } = &self.settings;
        if self.settings.patience.is_some() || !self.learner.ready {
            return None;
        }
        let episodes = if self.settings.one_process { config.evaluation.episodes_max() } else { 0 };
        Some(self.advanced + limits.stall + limits.evaluation_of(episodes))
    }

    fn check_training(&mut self) -> Result<(), Failure> {
        if self.stalled().is_some_and(|deadline| self.now >= deadline) {
            return Err(Failure::new(format!(
                "neither a step nor an update for {:?}: a worker or the learner hangs; see {}",
                self.settings.limits.stall,
                shown(&self.settings.run.path().join("logs"))
            )));
        }
        if self.time_is_up().is_some_and(|deadline| self.now >= deadline) {
            self.drain("run.max_minutes has elapsed".to_owned());
        }
        Ok(())
    }

    fn check_learner_ends(&mut self, deadline: Instant) -> Result<(), Failure> {
        let hub = self.settings.hub;
        let running = self.children.running(hub);
        if self.now < deadline || running.is_none_or(|hub| hub.killed_for.is_some()) {
            return Ok(());
        }
        let limit = self.settings.limits.drain;
        self.kill(hub, Death::too_slow(format!("not done within {limit:?}")));
        if !self.learner.finished {
            return Err(Failure::new(format!("{hub} did not finish within {limit:?}: killed it")));
        }
        self.warn(hub, format!("{hub} did not exit within {limit:?}: killed it"));
        Ok(())
    }

    /// Fails if a process has survived SIGKILL, which happens only after a fault of the kernel or a
    /// device. Such a process can be neither used nor replaced.
    fn check_killed(&self) -> Result<(), Failure> {
        let survives = |running: &Running| running.ends_by.is_some_and(|at| self.now >= at);
        match self.children.all_running().find(|(_, running)| survives(running)) {
            Some((process, _)) => {
                let limit = self.settings.limits.killed;
                let message = format!("{process} did not exit within {limit:?} of SIGKILL");
                Err(Failure::new(message).advice(self.resume_advice()))
            }
            None => Ok(()),
        }
    }

    fn restart_due(&mut self) {
        let due = |at: Option<Instant>| at.is_some_and(|at| self.now >= at);
        let slots = self.children.slots.iter().filter(|(_, slot)| due(slot.restart_at));
        let processes: Vec<Process> = slots.map(|(process, _)| *process).collect();
        for process in processes {
            if self.may_start(process) {
                self.start(process);
            }
        }
    }

    /// Whether a process whose back-off has passed may start. See [`Machine::on_learner_death`].
    fn may_start(&self, process: Process) -> bool {
        process != Process::Learner || !self.learner.waits_for_evaluator
    }

    /// Iterates over processes that are not ready. Once the learner has finished, this excludes
    /// workers, which are no longer needed.
    fn starting(&self) -> impl Iterator<Item = (Process, &Running)> {
        let needed = |process: Process| !(self.learner.finished && process.is_worker());
        self.children
            .all_running()
            .filter(move |(_, running)| !running.ready && running.killed_for.is_none())
            .filter(move |(process, _)| needed(*process))
    }

    /// Maximum time from the start of a process to its readiness. A learner imitates demonstrations
    /// before it is ready; a relay waits for a policy.
    fn ready_limit(&self, process: Process) -> Duration {
        let Settings { config, limits, .. } = &self.settings;
        if let Some(patience) = self.settings.patience.filter(|_| process == self.settings.hub) {
            return limits.ready.saturating_add(patience);
        }
        let updates = match process {
            Process::Learner if config.demonstrations.are_cloned() => {
                config.demonstrations.cloning_updates
            }
            _ => 0,
        };
        let updates = u32::try_from(updates).unwrap_or(u32::MAX);
        limits.ready.saturating_add(limits.cloning_update.saturating_mul(updates))
    }

    fn check_ready(&mut self) -> Result<(), Failure> {
        let late = |(process, running): &(Process, &Running)| {
            self.now >= running.spawned + self.ready_limit(*process)
        };
        let late: Vec<Process> = self.starting().filter(late).map(|(process, _)| process).collect();
        for process in late {
            let limit = self.ready_limit(process);
            self.kill(process, Death::too_slow(format!("not ready within {limit:?}")));
            let restarts = self.children.slots.get(&process).map_or(0, |slot| slot.restarts);
            if restarts == 0 && !self.is_joined(process) {
                let error = anyhow!("{process} was not ready within {limit:?}");
                return Err(Failure::from(error).log(process));
            }
            // The exit counts as a death.
            self.warn(process, format!("{process} was not ready within {limit:?}: killed it"));
        }
        Ok(())
    }

    fn check_evaluation(&mut self) {
        if self.evaluations.deadline().is_none_or(|deadline| self.now < deadline) {
            return;
        }
        // The restarted evaluator receives the request again, with a new deadline.
        self.evaluations.send_again();
        let message = "the evaluation is taking too long: killing the evaluator".to_owned();
        self.warn(Process::Evaluator, message);
        let death = Death::too_slow("an evaluation took too long".to_owned());
        self.kill(Process::Evaluator, death);
    }
}

#[cfg(test)]
pub(super) mod tests {
    use dmprl_shared::config::ExperimentConfig;

    use super::*;
    use crate::limits::TimeLimits;
    use dmprl_control::Report;
    use dmprl_run::{Manifest, RunDirectory};

    /// Creates a machine before its first event.
    pub(crate) fn machine(folder: &std::path::Path, now: Instant) -> Machine {
        let config = ExperimentConfig::default();
        let manifest = Manifest::new(None).unwrap();
        let settings = Settings {
            run: RunDirectory::create(&folder.join("run"), &config, &manifest).unwrap(),
            config,
            limits: TimeLimits::default(),
            hub: Process::Learner,
            one_process: false,
            patience: None,
            earlier: Totals::default(),
            spec: None,
        };
        Machine::new(settings, now)
    }

    /// Regression test: an evaluator that is killed with the learner may have answered already.
    /// Such an answer once ended the run.
    #[test]
    fn an_answer_to_a_dead_learner_is_ignored_and_an_unrequested_one_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let now = Instant::now();
        let answer = || Report::NotEvaluated { policy_version: 7, reason: "a broken arm".into() };
        let after_answer = |waits_for_evaluator| {
            let folder = folder.path().join(format!("{waits_for_evaluator}"));
            let mut machine = machine(&folder, now);
            machine.children.start(Process::Evaluator, now);
            machine.learner.waits_for_evaluator = waits_for_evaluator;
            machine.step(Event::Report(Process::Evaluator, answer()), now);
            machine.failure.map(|failure| failure.error.to_string())
        };
        let error = after_answer(false).unwrap();
        assert!(error.contains("policy 7 without a request"), "{error}");
        assert_eq!(after_answer(true), None);
    }
}
