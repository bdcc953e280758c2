//! The supervisor: its state, its loop, and how children are started.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::{Context, Error};
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::Sent;
use tokio::sync::mpsc;

use super::child::{Child, EVENTS_MAX, Event};
use super::deaths::Death;
use super::evaluations::EvaluationQueue;
use super::{Launcher, Process, RunEvent, RunObserver, TimeLimits, joining};
use crate::control::{Command, Doing, EvaluationRow, HostNow, Progress};

/// What the supervisor needs to know.
pub struct SupervisorPlan {
    /// How children are started, and for which run.
    pub launcher: Launcher,
    /// The resolved configuration.
    pub config: ExperimentConfig,
    /// How long it waits for what.
    pub limits: TimeLimits,
    /// Counts of earlier sessions of the run.
    pub earlier: EarlierSessions,
    /// One item an interrupt.
    pub interrupts: mpsc::Receiver<()>,
}

/// Counts of a run's earlier sessions, as its newest checkpoint has them. The supervisor adds those
/// of its own session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct EarlierSessions {
    /// Failures of environments.
    pub env_failures: u64,
    /// Segments that workers have produced, sent and had acknowledged.
    pub sent: Sent,
    /// Restarts of the learner after a death.
    pub learner_restarts: u64,
    /// Restarts of workers after a death.
    pub worker_restarts: u64,
}

/// How a session ended.
#[derive(Debug)]
pub enum Ending {
    /// The learner came to its end and every evaluation was answered.
    Completed,
    /// The user stopped it.
    Interrupted,
    /// It could not go on.
    Failed(Error),
}

/// What a session did.
#[derive(Debug)]
pub struct SessionReport {
    /// How it ended.
    pub ending: Ending,
    /// Whether the learner's last moment is in a checkpoint.
    pub checkpointed: bool,
    /// The first progress reported.
    pub first: Option<Progress>,
    /// The last progress reported.
    pub last: Option<Progress>,
    /// Between the two.
    pub training: Duration,
    /// The last evaluation.
    pub last_row: Option<EvaluationRow>,
    /// Failures of environments that were reported.
    pub env_failures: u64,
    /// Starts of the learner after a death.
    pub learner_restarts: u64,
    /// From the first start to the last exit.
    pub wall: Duration,
}

/// Where a session is on its way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Phase {
    /// Starting and learning.
    Training,
    /// The learner was asked to come to its end.
    Draining { deadline: Instant },
    /// It has, and exits; evaluations are outstanding.
    Finishing { deadline: Instant },
    /// Everything is to end.
    Stopping { deadline: Instant, killed: bool },
}

/// A child's place: the child may be dead and its restart due.
#[derive(Debug, Default)]
pub(super) struct Slot {
    pub(super) running: Option<Running>,
    /// All starts of this session: each has a number of its own.
    pub(super) starts: u32,
    /// Restarts since it was last known to do its work.
    pub(super) restarts: u32,
    pub(super) restart_at: Option<Instant>,
    /// What a worker did in this session.
    pub(super) sent: Sent,
}

/// A child that lives.
#[derive(Debug)]
pub(super) struct Running {
    pub(super) child: Child,
    pub(super) spawned: Instant,
    pub(super) ready: bool,
    /// A worker that knows where the learner is, and finds the next by itself.
    pub(super) attached: bool,
    /// When it last said anything, and what it then did.
    pub(super) heard: Instant,
    pub(super) doing: Option<Doing>,
    /// Segments that it keeps, as it then said.
    pub(super) kept: u64,
    /// When it first and last told of work: a worker of segments sent, a learner of checkpoints.
    pub(super) worked: Option<(Instant, Instant)>,
    /// A worker that had joined has said that it leaves.
    pub(super) left: bool,
    /// Why the supervisor has killed it.
    pub(super) killed_for: Option<Death>,
}

impl Running {
    pub(super) fn new(child: Child) -> Self {
        let now = Instant::now();
        Self {
            child,
            spawned: now,
            ready: false,
            attached: false,
            heard: now,
            doing: None,
            kept: 0,
            worked: None,
            left: false,
            killed_for: None,
        }
    }

    /// SIGKILL; the exit, which comes as an event, is then told as this.
    pub(super) fn kill_for(&mut self, death: Death) {
        self.child.kill();
        self.killed_for = Some(death);
    }
}

pub(super) struct Supervisor<'a> {
    pub(super) launcher: Launcher,
    pub(super) config: ExperimentConfig,
    pub(super) limits: TimeLimits,
    observer: &'a mut dyn RunObserver,
    pub(super) events: mpsc::Sender<Event>,
    pub(super) slots: BTreeMap<Process, Slot>,
    pub(super) phase: Phase,
    pub(super) spec: Option<EnvSpec>,
    pub(super) learner_ready: bool,
    /// Starts of the learner after a death in this session.
    pub(super) learner_restarts: u64,
    /// Since when nothing has been learned.
    pub(super) learner_died: Option<Instant>,
    /// The evaluator was killed with its learner, and has not ended yet.
    pub(super) evaluator_ends: bool,
    pub(super) finished: bool,
    /// Whether the newest report of progress was followed by a checkpoint.
    pub(super) checkpointed: bool,
    pub(super) evaluations: EvaluationQueue,
    pub(super) interrupts: u32,
    pub(super) interrupted_at: Option<Instant>,
    pub(super) failure: Option<Error>,
    pub(super) abandoned: bool,
    pub(super) garbage: u32,
    pub(super) started: Instant,
    /// When steps or updates last grew.
    pub(super) advanced: Instant,
    pub(super) first: Option<(Instant, Progress)>,
    pub(super) last: Option<(Instant, Progress)>,
    /// When the live display was last drawn.
    pub(super) drawn: Instant,
    pub(super) best_return: f64,
    pub(super) last_row: Option<EvaluationRow>,
    pub(super) earlier: EarlierSessions,
    /// Other hosts that take part, as the gateway says.
    pub(super) hosts: Vec<HostNow>,
    /// Failures of environments in this session, and what its workers did.
    pub(super) env_failures: u64,
    pub(super) sent: Sent,
    /// Starts of workers after a death in this session.
    pub(super) worker_restarts: u64,
    /// When `processes.json` is to be written next; none once that has failed.
    pub(super) processes_due: Option<Instant>,
}

/// What ended the supervisor's wait.
enum Wake {
    Interrupt,
    Event(Event),
    Time,
}

/// Runs the processes of one session until all of them have ended.
pub async fn supervise(mut plan: SupervisorPlan, observer: &mut dyn RunObserver) -> SessionReport {
    let (_, unused) = mpsc::channel(1);
    let mut interrupts = std::mem::replace(&mut plan.interrupts, unused);
    let (events, mut incoming) = mpsc::channel(EVENTS_MAX);
    let mut woke = Instant::now();
    let mut supervisor = Supervisor::new(plan, observer, events);
    let started = supervisor.start();
    supervisor.check(started);
    while !supervisor.is_over() {
        // A terminal that takes nothing (Ctrl-S) may have held it up.
        let looked = Instant::now();
        supervisor.on_wake(woke, woke, looked);
        let due = supervisor.next_deadline();
        let wake = tokio::select! {
            biased;
            Some(()) = interrupts.recv() => Wake::Interrupt,
            Some(event) = incoming.recv() => Wake::Event(event),
            () = tokio::time::sleep_until(due.into()) => Wake::Time,
        };
        woke = Instant::now();
        supervisor.on_wake(looked, due, woke);
        match wake {
            Wake::Interrupt => supervisor.on_interrupt(),
            Wake::Event(event) => supervisor.take(event),
            Wake::Time => {
                // Whoever has spoken meanwhile is heard first.
                tokio::task::yield_now().await;
                if incoming.is_empty() {
                    supervisor.check_heartbeats(woke);
                }
            }
        }
        let handled = supervisor.on_time(woke);
        supervisor.check(handled);
        supervisor.refresh(woke);
        supervisor.tell_processes(woke);
    }
    supervisor.tell_end();
    supervisor.report()
}

impl<'a> Supervisor<'a> {
    /// Nothing is started yet. What happens to children comes through the other end of `events`.
    pub(super) fn new(
        plan: SupervisorPlan,
        observer: &'a mut dyn RunObserver,
        events: mpsc::Sender<Event>,
    ) -> Self {
        let SupervisorPlan { launcher, config, limits, earlier, .. } = plan;
        let now = Instant::now();
        let limit = limits.evaluation_of(config.evaluation.episodes_max());
        Self {
            launcher,
            config,
            limits,
            observer,
            events,
            slots: BTreeMap::new(),
            phase: Phase::Training,
            spec: None,
            learner_ready: false,
            learner_restarts: 0,
            learner_died: None,
            evaluator_ends: false,
            finished: false,
            checkpointed: false,
            evaluations: EvaluationQueue::new(limit),
            interrupts: 0,
            interrupted_at: None,
            failure: None,
            abandoned: false,
            garbage: 0,
            started: now,
            advanced: now,
            first: None,
            last: None,
            drawn: now,
            best_return: f64::NEG_INFINITY,
            last_row: None,
            earlier,
            hosts: Vec::new(),
            env_failures: 0,
            sent: Sent::default(),
            worker_restarts: 0,
            processes_due: Some(now),
        }
    }

    /// Passes an event to the observer.
    pub(super) fn tell(&mut self, event: RunEvent) {
        self.observer.on_event(event);
    }

    /// Passes a message for the user to the observer.
    pub(super) fn message(&mut self, text: &str) {
        self.tell(RunEvent::Message(text.to_owned()));
    }

    pub(super) fn shows_processes(&self) -> bool {
        self.observer.shows_processes()
    }

    fn take(&mut self, event: Event) {
        let handled = self.on_event(event);
        self.check(handled);
    }

    /// Workers first: the learner needs to know the environment. A resumed run knows it.
    fn start(&mut self) -> anyhow::Result<()> {
        let run = &self.launcher.run;
        self.spec = run.spec()?;
        self.best_return = run.best_row()?.map_or(f64::NEG_INFINITY, |row| row.return_mean);
        if self.is_one_process() || self.spec.is_some() {
            self.spawn(self.hub())?;
        }
        if self.is_one_process() {
            return Ok(());
        }
        let workers = u32::try_from(self.config.actors.workers).context("too many workers")?;
        let joined_max = self.config.actors.joined_max;
        if let Some(domain) = self.launcher.domain.as_ref().filter(|_| joined_max > 0)
            && let Err(error) = joining::listen(domain, self.events.clone())
        {
            self.message(&format!("warning: nobody can join this run: {error:#}"));
        }
        (0..workers).try_for_each(|index| self.spawn(Process::Actor(index)))
    }

    /// What workers send to: the learner, or what stands for it on this host.
    pub(super) fn hub(&self) -> Process {
        self.launcher.hub()
    }

    pub(super) fn is_one_process(&self) -> bool {
        self.launcher.domain.is_none()
    }

    pub(super) fn spawn(&mut self, process: Process) -> anyhow::Result<()> {
        let slot = self.slots.entry(process).or_default();
        slot.restart_at = None;
        let command = self.launcher.command(process, slot.starts)?;
        slot.starts += 1;
        slot.running = Some(Running::new(Child::spawn(command, process, self.events.clone())?));
        Ok(())
    }

    pub(super) fn running(&self, process: Process) -> Option<&Running> {
        self.slots.get(&process)?.running.as_ref()
    }

    pub(super) fn all_running(&self) -> impl Iterator<Item = (Process, &Running)> {
        self.slots.iter().filter_map(|(process, slot)| Some((*process, slot.running.as_ref()?)))
    }

    /// Workers that are attached: the run's own, and those that have joined.
    pub(super) fn workers(&self) -> usize {
        let attached = self.all_running().filter(|(process, running)| {
            matches!(process, Process::Actor(_)) && running.attached && running.killed_for.is_none()
        });
        attached.count()
    }

    /// Sends a command to a child. One that takes none is stuck or dying; its deadline or its
    /// exit follows.
    pub(super) fn send(&mut self, process: Process, command: Command) {
        let sent = self.running(process).is_none_or(|running| running.child.send(command));
        if !sent {
            self.message(&format!("{process} takes no commands"));
        }
    }

    fn is_over(&self) -> bool {
        let stopping = matches!(self.phase, Phase::Stopping { .. });
        stopping && (self.abandoned || self.all_running().next().is_none())
    }

    fn report(mut self) -> SessionReport {
        self.tell(RunEvent::Ended);
        let ending = match self.failure {
            Some(error) => Ending::Failed(error),
            None if self.interrupts > 0 => Ending::Interrupted,
            None => Ending::Completed,
        };
        let training = match (&self.first, &self.last) {
            (Some((first, _)), Some((last, _))) => last.duration_since(*first),
            _ => Duration::ZERO,
        };
        SessionReport {
            ending,
            checkpointed: self.finished && self.checkpointed,
            first: self.first.map(|(_, progress)| progress),
            last: self.last.map(|(_, progress)| progress),
            training,
            last_row: self.last_row,
            env_failures: self.env_failures,
            learner_restarts: self.learner_restarts,
            wall: self.started.elapsed(),
        }
    }
}
