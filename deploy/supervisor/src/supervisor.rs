//! The supervisor's loop: waits for events, passes them to the state machine, and performs the
//! actions that it returns.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use anyhow::Error;
use dmprl_control::{Command, EvaluationRow, JoinAnswer, Progress, Welcome};
use dmprl_run::format::shown;
use dmprl_run::{LockWatch, Processes, RunDirectory};
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::spec::EnvSpec;
use tokio::sync::mpsc;

use super::child::{Child, ChildEvent, EVENTS_MAX, Incoming, PendingJoin};
use super::launcher::Launcher;
use super::limits::TimeLimits;
use super::logs::log_tail;
use super::machine::Machine;
use super::observer::{RunEvent, RunObserver};
use super::process::Process;
use super::state::Settings;
use super::step::{Action, Admission, Event, Failure, ResumeAdvice, Successor};
use super::suspension::{lateness, suspension};
use super::totals::Totals;
use super::{joining, views};

/// A supervisor this late cannot distinguish a worker that hangs from one that was suspended too.
const LATE: Duration = Duration::from_secs(1);
/// Maximum interval between checks for the shared-memory directory: each is one `stat`.
const DOMAIN_CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// Interval between redraws of the live display. Workers send a heartbeat every second, so events
/// are frequent enough.
const REDRAW_INTERVAL: Duration = Duration::from_millis(500);
/// Interval between writes of `processes.json`.
const PROCESSES_INTERVAL: Duration = Duration::from_secs(2);

/// Inputs of [`supervise`].
pub struct SupervisorPlan {
    /// How to start children, and the run.
    pub launcher: Launcher,
    /// Tells whether the run's lock was lost.
    pub lock: LockWatch,
    /// The resolved configuration.
    pub config: ExperimentConfig,
    /// Time limits.
    pub limits: TimeLimits,
    /// Counts of earlier sessions of the run.
    pub earlier: Totals,
    /// One item per interrupt.
    pub interrupts: mpsc::Receiver<()>,
}

/// How a session ended.
#[derive(Debug)]
pub enum Ending {
    /// The learner finished, and every evaluation was answered.
    Completed,
    /// The user stopped it.
    Interrupted,
    /// It could not continue.
    Failed(Error),
}

/// Results of a session.
#[derive(Debug)]
pub struct SessionReport {
    /// How it ended.
    pub ending: Ending,
    /// Whether a checkpoint has the learner's last state.
    pub checkpointed: bool,
    /// The first progress.
    pub first: Option<Progress>,
    /// The last progress.
    pub last: Option<Progress>,
    /// Time between the two.
    pub training: Duration,
    /// The last evaluation.
    pub last_row: Option<EvaluationRow>,
    /// Failures of environments.
    pub env_failures: u64,
    /// Restarts of the learner after a death.
    pub learner_restarts: u64,
    /// Time from the first start to the last exit.
    pub wall: Duration,
}

struct Supervisor<'a> {
    machine: Machine,
    launcher: Launcher,
    lock: LockWatch,
    observer: &'a mut dyn RunObserver,
    events: mpsc::Sender<Incoming>,
    children: BTreeMap<Process, Child>,
    /// Workers that wait for an answer, by number of their request.
    joining: BTreeMap<u64, PendingJoin>,
    join_requests: u64,
    /// The best row so far.
    best: Option<EvaluationRow>,
    started: Instant,
    /// Last redraw of the live display.
    drawn: Instant,
    /// Next write of `processes.json`; `None` after a failure.
    processes_due: Option<Instant>,
}

/// Why the supervisor woke.
enum Wake {
    Interrupt,
    Incoming(Incoming),
    Time,
}

/// Runs the processes of a session until all have ended.
pub async fn supervise(plan: SupervisorPlan, observer: &mut dyn RunObserver) -> SessionReport {
    let SupervisorPlan { launcher, lock, config, limits, earlier, mut interrupts } = plan;
    let (events, mut incoming) = mpsc::channel(EVENTS_MAX);
    let mut woke = Instant::now();
    let (known, unreadable) = match Known::read(&launcher.run) {
        Ok(known) => (known, None),
        Err(error) => (Known::default(), Some(error)),
    };
    let settings = Settings {
        config,
        limits,
        hub: launcher.hub(),
        one_process: launcher.domain.is_none(),
        patience: launcher.upstream.as_ref().map(|it| Duration::from_secs(it.patience_s)),
        run: launcher.run.clone(),
        earlier,
        spec: known.spec,
    };
    let machine = Machine::new(settings, woke);
    let mut supervisor = Supervisor::new(machine, launcher, observer, events);
    supervisor.lock = lock;
    supervisor.best = known.best;
    supervisor.step(unreadable.map_or(Event::Begin, Event::ActionFailed));
    while !supervisor.machine.is_over() {
        // A blocked terminal (Ctrl-S) can delay a turn.
        let looked = Instant::now();
        supervisor.on_wake(woke, woke, looked);
        let due = supervisor.next_deadline();
        let wake = tokio::select! {
            biased;
            Some(()) = interrupts.recv() => Wake::Interrupt,
            Some(event) = incoming.recv() => Wake::Incoming(event),
            () = tokio::time::sleep_until(due.into()) => Wake::Time,
        };
        woke = Instant::now();
        supervisor.on_wake(looked, due, woke);
        match wake {
            Wake::Interrupt => supervisor.step(Event::Interrupt),
            Wake::Incoming(event) => supervisor.take(event),
            Wake::Time => {
                // Let the reading tasks deliver reports that arrived meanwhile.
                tokio::task::yield_now().await;
                supervisor.step(Event::Tick { all_heard: incoming.is_empty() });
            }
        }
        supervisor.check_domain();
        supervisor.check_lock();
        supervisor.refresh(woke);
        supervisor.write_processes_if_due(woke);
    }
    supervisor.write_processes(true);
    supervisor.report()
}

/// Results of earlier sessions.
#[derive(Default)]
struct Known {
    spec: Option<EnvSpec>,
    best: Option<EvaluationRow>,
}

impl Known {
    fn read(run: &RunDirectory) -> anyhow::Result<Self> {
        Ok(Self { spec: run.spec()?, best: run.best_row()? })
    }
}

impl<'a> Supervisor<'a> {
    fn new(
        machine: Machine,
        launcher: Launcher,
        observer: &'a mut dyn RunObserver,
        events: mpsc::Sender<Incoming>,
    ) -> Self {
        let now = Instant::now();
        Self {
            machine,
            launcher,
            lock: LockWatch::default(),
            observer,
            events,
            children: BTreeMap::new(),
            joining: BTreeMap::new(),
            join_requests: 0,
            best: None,
            started: now,
            drawn: now,
            processes_due: Some(now),
        }
    }

    /// Passes an event to the machine and performs its actions, then handles the events of actions
    /// that failed.
    fn step(&mut self, event: Event) {
        let mut events = VecDeque::from([event]);
        while let Some(event) = events.pop_front() {
            for action in self.machine.step(event, Instant::now()) {
                events.extend(self.perform(action));
            }
        }
    }

    fn take(&mut self, incoming: Incoming) {
        let event = match incoming {
            Incoming::Child(process, ChildEvent::Report(report)) => Event::Report(process, report),
            Incoming::Child(process, ChildEvent::Garbage(line)) => Event::Garbage(process, line),
            Incoming::Child(process, ChildEvent::Exited(status)) => {
                self.children.remove(&process);
                Event::Exited(process, status)
            }
            Incoming::Child(process, ChildEvent::Gone) => {
                self.children.remove(&process);
                Event::Gone(process)
            }
            Incoming::Join(pending) => {
                self.join_requests += 1;
                let (request, id) = (self.join_requests, pending.id);
                let speaks = pending.speaks.clone();
                self.joining.insert(request, pending);
                Event::JoinRequested { request, id, speaks }
            }
        };
        self.step(event);
    }

    /// Performs an action; returns the event of its failure.
    fn perform(&mut self, action: Action) -> Option<Event> {
        match action {
            Action::Start { process, start, successor } => {
                let started = self.start(process, start, successor);
                return started.err().map(|error| Event::StartFailed(process, error));
            }
            Action::Attach(process) => {
                if let Some(domain) = self.launcher.domain.clone() {
                    self.send(process, Command::Attach { domain });
                }
            }
            Action::Send(process, command) => self.send(process, command),
            Action::Kill(process) => {
                if let Some(child) = self.children.get(&process) {
                    child.kill();
                }
            }
            Action::Listen => self.listen(),
            Action::Admit(admission) => {
                let process = Process::Actor(admission.index);
                return self.admit(admission).err().map(|it| Event::StartFailed(process, it));
            }
            Action::Refuse { request, reason } => {
                if let Some(pending) = self.joining.remove(&request) {
                    pending.refuse(reason);
                }
            }
            Action::WriteSpec(spec) => {
                return self.launcher.run.write_spec(&spec).err().map(Event::ActionFailed);
            }
            Action::Rewind => return self.rewind().err().map(Event::ActionFailed),
            Action::Notify(event) => self.notify(event),
            Action::NotifyFailure(failure) => {
                let message = format!("while stopping: {:#}", self.render(failure));
                self.warn(message);
            }
        }
        None
    }

    fn start(
        &mut self,
        process: Process,
        start: u32,
        successor: Option<Successor>,
    ) -> anyhow::Result<()> {
        if let Some(Successor { restarts }) = successor {
            self.launcher.learner_restarts = restarts;
            self.launcher.resume = self.launcher.run.has_checkpoint()?;
            if !self.launcher.resume {
                self.launcher.run.begin_again()?;
            }
        }
        let command = self.launcher.command(process, start)?;
        let child = Child::spawn(command, process, self.events.clone())?;
        self.children.insert(process, child);
        Ok(())
    }

    /// Sends a command without waiting. A child that accepts no commands is stuck or dying, so its
    /// deadline or its exit follows. Warns only about commands that the child needs.
    fn send(&mut self, process: Process, command: Command) {
        let matters = !matches!(
            command,
            Command::Stop | Command::EnvFailures { .. } | Command::Sent(_) | Command::Workers(_)
        );
        let sent = self.children.get(&process).is_none_or(|child| child.send(command));
        if !sent && matters {
            let message = format!("{process} accepts no commands");
            self.notify(RunEvent::Warning { process: Some(process), message });
        }
    }

    fn listen(&mut self) {
        let Some(domain) = &self.launcher.domain else { return };
        if let Err(error) = joining::listen(domain, self.events.clone()) {
            self.warn(format!("warning: workers cannot join this run: {error:#}"));
        }
    }

    fn admit(&mut self, admission: Admission) -> anyhow::Result<()> {
        let Admission { request, index, start, workers } = admission;
        let Some(pending) = self.joining.remove(&request) else { return Ok(()) };
        let incarnation = self.launcher.incarnation(start)?;
        let welcome = Welcome { index, incarnation, venv: self.launcher.venv.clone(), workers };
        let (process, answer) = (Process::Actor(index), JoinAnswer::Welcome(welcome));
        let child = Child::join(pending, &answer, process, self.events.clone())?;
        self.children.insert(process, child);
        Ok(())
    }

    fn rewind(&mut self) -> anyhow::Result<()> {
        let evaluations = self.launcher.run.evaluations()?;
        self.best = self.launcher.run.best_row()?;
        self.observer.on_event(RunEvent::Rewound { evaluations });
        Ok(())
    }

    fn warn(&mut self, message: String) {
        self.notify(RunEvent::Warning { process: None, message });
    }

    /// Passes an event to the observer. Adds whether a row is the best one, and process lines.
    fn notify(&mut self, mut event: RunEvent) {
        match &mut event {
            RunEvent::Evaluated { row, is_best } => {
                *is_best = self.best.as_ref().is_none_or(|best| row.compare(best).is_gt());
                if *is_best {
                    self.best = Some(row.clone());
                }
            }
            RunEvent::Progress { processes, .. } if self.observer.shows_processes() => {
                self.drawn = Instant::now();
                *processes = views::process_lines(&self.machine, self.drawn);
            }
            _ => {}
        }
        self.observer.on_event(event);
    }

    /// Reports to the machine if the supervisor itself was suspended or late. It last ran at
    /// `looked`, should have woken at `due` at the latest, and woke at `now`.
    fn on_wake(&mut self, looked: Instant, due: Instant, now: Instant) {
        if let Some(lost) = suspension(looked, due, now) {
            self.step(Event::Suspended(lost));
        } else if lateness(looked, due, now) >= LATE {
            self.step(Event::Late);
        }
    }

    fn next_deadline(&self) -> Instant {
        let now = Instant::now();
        let deadline = self.machine.next_deadline(now);
        let watches_domain = self.machine.needs_domain() && self.launcher.domain.is_some();
        if watches_domain { deadline.min(now + DOMAIN_CHECK_INTERVAL) } else { deadline }
    }

    /// Ends the run if its shared-memory directory was removed.
    ///
    /// Mapped memory remains, so segments continue to arrive. But no process can attach any more,
    /// so a dead process could not be replaced. The run ends while a checkpoint is still possible.
    fn check_domain(&mut self) {
        let domain = self.launcher.domain.as_ref().filter(|_| self.machine.needs_domain());
        if let Some(domain) = domain.filter(|domain| !domain.is_dir()) {
            self.step(Event::DomainLost(domain.clone()));
        }
    }

    /// Ends the run if another process has taken it over.
    fn check_lock(&mut self) {
        if let Some(holder) = self.lock.lost_to().map(str::to_owned) {
            // Once: the run cannot get it back.
            self.lock = LockWatch::default();
            // The files belong to the other process now.
            self.processes_due = None;
            self.step(Event::LockLost(holder));
        }
    }

    /// Redraws the live display between two reports of progress, so that deaths and restarts are
    /// visible without progress.
    fn refresh(&mut self, now: Instant) {
        if self.observer.shows_processes() && now.duration_since(self.drawn) >= REDRAW_INTERVAL {
            self.drawn = now;
            let processes = views::process_lines(&self.machine, now);
            self.observer.on_event(RunEvent::Processes(processes));
        }
    }

    fn write_processes_if_due(&mut self, now: Instant) {
        if self.processes_due.is_some_and(|due| now >= due) {
            self.processes_due = now.checked_add(PROCESSES_INTERVAL);
            self.write_processes(false);
        }
    }

    /// Writes `processes.json`. The run continues without this file if that fails.
    fn write_processes(&mut self, ended: bool) {
        if self.processes_due.is_none() {
            return;
        }
        let usage = |process| {
            let id = self.children.get(&process).and_then(Child::id);
            id.map(views::usage_of).unwrap_or_default()
        };
        let rows = views::process_rows(&self.machine, usage, Instant::now());
        let table = Processes::new(ended, self.started.elapsed().as_secs_f64(), rows);
        if let Err(error) = self.launcher.run.write_processes(&table) {
            self.warn(format!("warning: {error:#}; the run continues without this file"));
            self.processes_due = None;
        }
    }

    /// Formats a failure, with the last lines of a log and advice.
    fn render(&self, failure: Failure) -> Error {
        let Failure { mut error, log, advice, context } = failure;
        let run = &self.launcher.run;
        let tail = log.map(|process| log_tail(&run.log_path(&process.to_string())));
        let resumable = match advice {
            ResumeAdvice::Never => false,
            ResumeAdvice::IfCheckpoint => run.has_checkpoint().unwrap_or(false),
            ResumeAdvice::Always => true,
        };
        let advice = resumable.then(|| {
            format!("\n  resume from the last checkpoint: dmprl resume {}", shown(run.path()))
        });
        if tail.is_some() || advice.is_some() {
            let (tail, advice) = (tail.unwrap_or_default(), advice.unwrap_or_default());
            error = anyhow::anyhow!("{error}{tail}{advice}");
        }
        match context {
            Some(context) => error.context(context),
            None => error,
        }
    }

    fn report(mut self) -> SessionReport {
        self.observer.on_event(RunEvent::Ended);
        let failure = self.machine.failure.take().map(|failure| self.render(failure));
        let Machine { interrupts, learner, first, last, last_row, totals, .. } = self.machine;
        let ending = match failure {
            Some(error) => Ending::Failed(error),
            None if interrupts > 0 => Ending::Interrupted,
            None => Ending::Completed,
        };
        let training = match (&first, &last) {
            (Some(first), Some(last)) => last.at.duration_since(first.at),
            _ => Duration::ZERO,
        };
        SessionReport {
            ending,
            checkpointed: learner.finished && learner.checkpointed,
            first: first.map(|milestone| milestone.progress),
            last: last.map(|milestone| milestone.progress),
            training,
            last_row,
            env_failures: totals.env_failures,
            learner_restarts: totals.learner_restarts,
            wall: self.started.elapsed(),
        }
    }
}
