//! The simulated world: time, children and messages in flight.

mod invariants;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use anyhow::anyhow;
use dmprl_control::{Command, Greeting, Report};
use dmprl_run::RunDirectory;
use dmprl_shared::seeds::{self, Stream};
use dmprl_shared::transport::delivery::Sent;
use rand::RngExt;

use super::fakes::{Fake, Mode, Output};
use super::scenario::{EARLIER_FAILURES, settings};
use super::tally::Tally;
use crate::machine::Machine;
use crate::observer::{AfterDeath, NotEvaluated, RunEvent};
use crate::process::Process;
use crate::step::{Action, Event};

/// Maximum delay of an output. It is less than the limit from SIGKILL to the exit, which arrives
/// after all outputs.
const LATE_MS: u64 = 4_000;
/// Time until faults stop.
const FAULTS_S: u64 = 120;
/// Maximum duration of a session.
const SESSION_LIMIT: Duration = Duration::from_secs(4 * 3_600);
/// Maximum number of steps of a session.
const STEPS_MAX: u32 = 50_000;

/// A scheduled event of the world.
#[derive(Debug)]
enum ScheduledEvent {
    /// A process takes a turn; the number identifies its start.
    Turn(Process, u64),
    /// An output of a process arrives.
    Arrival(Process, Output),
    JoinRequest,
    Interrupt,
    /// The supervisor is suspended.
    Suspension,
    DomainLost,
    /// Another host takes the run over.
    LockLost,
    /// Faults end.
    Heal,
}

/// Expected state, which the invariants compare with the machine.
#[derive(Debug, Default)]
struct Model {
    env_failures: u64,
    sent: Sent,
    /// Versions of requested evaluations without an answer.
    requests: BTreeSet<u64>,
    /// Versions that were sent to an evaluator.
    sent_requests: BTreeSet<u64>,
    given_up: BTreeSet<Process>,
    /// Deadline for the end of a session that stops.
    stops_by: Option<Instant>,
}

pub struct World {
    random: Stream,
    mode: Mode,
    machine: Machine,
    began: Instant,
    now: Instant,
    /// Living processes.
    fakes: BTreeMap<Process, Fake>,
    /// Number of each process's last start.
    serials: BTreeMap<Process, u64>,
    agenda: BTreeMap<(Instant, u64), ScheduledEvent>,
    order: u64,
    version: u64,
    join_requests: u64,
    /// A process that survives SIGKILL.
    immortal: Option<Process>,
    model: Model,
    tally: Tally,
}

impl World {
    pub fn new(seed: u64, run: &RunDirectory) -> Self {
        let mut random = seeds::stream(seed, "supervisor", 0);
        let settings = settings(&mut random, run);
        let now = Instant::now();
        let mut tally = Tally::default();
        if settings.one_process {
            tally.count("one process");
        }
        if settings.hub == Process::Relay {
            tally.count("hosts without a learner");
        }
        let mut world = Self {
            mode: Mode { faults: true, one_process: settings.one_process },
            machine: Machine::new(settings, now),
            began: now,
            now,
            fakes: BTreeMap::new(),
            serials: BTreeMap::new(),
            agenda: BTreeMap::new(),
            order: 0,
            version: 0,
            join_requests: 0,
            immortal: None,
            model: Model::default(),
            tally,
            random,
        };
        world.plan_faults();
        world
    }

    fn chance(&mut self, one_in: u32) -> bool {
        self.mode.faults && self.random.random_range(0..one_in) == 0
    }

    fn plan_faults(&mut self) {
        let at = |world: &mut Self, event| {
            let after = world.random.random_range(0..FAULTS_S * 1_000);
            world.plan(world.began + Duration::from_millis(after), event);
        };
        for _ in 0..self.random.random_range(0..5) {
            at(self, ScheduledEvent::JoinRequest);
        }
        if self.chance(3) {
            at(self, ScheduledEvent::Interrupt);
            at(self, ScheduledEvent::Interrupt);
        }
        if self.chance(4) {
            at(self, ScheduledEvent::Suspension);
        }
        if self.chance(40) {
            at(self, ScheduledEvent::DomainLost);
        }
        if self.chance(40) {
            at(self, ScheduledEvent::LockLost);
        }
        if self.chance(40) {
            let candidates = [Process::Actor(0), Process::Learner, Process::Evaluator];
            self.immortal = Some(candidates[self.random.random_range(0..3)]);
        }
        self.plan(self.began + Duration::from_secs(FAULTS_S), ScheduledEvent::Heal);
    }

    fn plan(&mut self, at: Instant, event: ScheduledEvent) {
        self.order += 1;
        self.agenda.insert((at, self.order), event);
    }

    /// Runs the session to its end.
    pub fn run(mut self) -> Tally {
        self.step(Event::Begin);
        let mut steps = 0;
        while !self.machine.is_over() {
            steps += 1;
            assert!(steps < STEPS_MAX, "no end after {steps} steps");
            let is_late = self.now >= self.began + SESSION_LIMIT;
            assert!(!is_late, "no end after {SESSION_LIMIT:?}: {:#?}", self.machine);
            let deadline = self.machine.next_deadline(self.now).max(self.now);
            match self.agenda.first_key_value() {
                Some(((at, _), _)) if *at <= deadline => self.handle_next(),
                _ => self.tick(deadline),
            }
        }
        self.check_end();
        self.tally
    }

    fn tick(&mut self, deadline: Instant) {
        self.now = deadline;
        let all_heard = !self.chance(10);
        self.step(Event::Tick { all_heard });
        if all_heard {
            let silent = self.machine.first_silent().filter(|(at, _)| *at <= self.now);
            assert!(silent.is_none(), "{silent:?} is silent for too long: {:#?}", self.machine);
        }
        if all_heard && !self.machine.is_over() {
            let next = self.machine.next_deadline(self.now);
            assert!(next > self.now, "a deadline remains due: {:#?}", self.machine);
        }
    }

    fn handle_next(&mut self) {
        let Some(((at, _), event)) = self.agenda.pop_first() else { return };
        self.now = self.now.max(at);
        match event {
            ScheduledEvent::Turn(process, serial) => self.turn(process, serial),
            ScheduledEvent::Arrival(process, output) => self.arrive(process, output),
            ScheduledEvent::JoinRequest => {
                self.join_requests += 1;
                let (request, id) = (self.join_requests, 1_000);
                let mut speaks = Greeting::this();
                if self.chance(8) {
                    speaks.version = "0.0.0".to_owned();
                }
                self.step(Event::JoinRequested { request, id, speaks });
            }
            ScheduledEvent::Interrupt => self.step(Event::Interrupt),
            ScheduledEvent::Suspension => {
                let lost = Duration::from_secs(self.random.random_range(5..10_000));
                self.now += lost;
                self.began += lost;
                if let Some(stops_by) = &mut self.model.stops_by {
                    *stops_by += lost;
                }
                self.step(Event::Suspended(lost));
                self.step(Event::Late);
            }
            ScheduledEvent::DomainLost if self.machine.needs_domain() => {
                self.tally.count("domain lost");
                self.step(Event::DomainLost("/dev/shm/gone".into()));
            }
            ScheduledEvent::DomainLost => {}
            ScheduledEvent::LockLost => {
                self.tally.count("lock lost");
                self.step(Event::LockLost("process 1 on host other".into()));
            }
            ScheduledEvent::Heal => {
                self.mode.faults = false;
                self.fakes.values_mut().for_each(Fake::heal);
            }
        }
    }

    /// Lets a living process take its turn.
    fn turn(&mut self, process: Process, serial: u64) {
        if self.serials.get(&process) != Some(&serial) {
            return;
        }
        let Some(fake) = self.fakes.get_mut(&process) else { return };
        let outputs = fake.turn(self.mode, &mut self.random, &mut self.version);
        let next = self.now + fake.turn_after(&mut self.random);
        self.emit(process, outputs);
        self.plan(next, ScheduledEvent::Turn(process, serial));
    }

    /// Schedules the arrival of outputs, perhaps late but in order.
    fn emit(&mut self, process: Process, outputs: Vec<Output>) {
        for output in outputs {
            let late = self.chance(4);
            let delay = self.random.random_range(0..if late { LATE_MS } else { 50 });
            let Some(fake) = self.fakes.get_mut(&process) else { return };
            let at = fake.last_output.max(self.now + Duration::from_millis(delay));
            fake.last_output = at;
            if matches!(output, Output::Exit(_) | Output::Gone) {
                self.fakes.remove(&process);
            }
            self.plan(at, ScheduledEvent::Arrival(process, output));
        }
    }

    fn arrive(&mut self, process: Process, output: Output) {
        let event = match output {
            Output::Report(report) => {
                self.expect(process, &report);
                Event::Report(process, report)
            }
            Output::Garbage => Event::Garbage(process, "hello".to_owned()),
            Output::Exit(status) => Event::Exited(process, status),
            Output::Gone => Event::Gone(process),
        };
        self.step(event);
    }

    /// Adds a report to the model.
    fn expect(&mut self, process: Process, report: &Report) {
        match report {
            Report::Sent(sent) => self.model.sent += *sent,
            Report::EnvFailures { count, .. } => {
                self.model.env_failures += count;
                self.tally.count("environment failures");
            }
            Report::EnvHung { .. } => self.model.env_failures += 1,
            Report::Evaluate(request) => {
                assert!(self.machine.children.running(process).is_some());
                self.model.requests.insert(request.policy_version);
            }
            Report::Evaluated(_) => {
                let evaluator = self.machine.children.running(Process::Evaluator);
                if evaluator.is_some_and(|evaluator| evaluator.killed_for.is_some()) {
                    self.tally.count("late answers");
                }
            }
            _ => {}
        }
    }

    /// Passes an event to the machine, performs its actions, and checks the invariants.
    fn step(&mut self, event: Event) {
        let mut events = VecDeque::from([event]);
        while let Some(event) = events.pop_front() {
            for action in self.machine.step(event, self.now) {
                events.extend(self.perform(action));
            }
        }
        self.check();
    }

    fn perform(&mut self, action: Action) -> Option<Event> {
        match action {
            Action::Start { process, .. } => {
                if self.chance(400) {
                    return Some(Event::StartFailed(process, anyhow!("no more processes")));
                }
                self.start(process, false);
            }
            Action::Admit(admission) => {
                self.tally.count("joined");
                self.start(Process::Actor(admission.index), true);
            }
            Action::Attach(process) => {
                self.deliver(process, Command::Attach { domain: "/dev/shm/run".into() });
            }
            Action::Send(process, command) => self.deliver(process, command),
            Action::Kill(process) => self.kill(process),
            Action::Refuse { .. } => self.tally.count("refused"),
            Action::Rewind if self.chance(50) => {
                return Some(Event::ActionFailed(anyhow!("a damaged file")));
            }
            Action::Notify(event) => self.hear(&event),
            Action::NotifyFailure(_) => self.tally.count("failures while stopping"),
            Action::Listen | Action::WriteSpec(_) | Action::Rewind => {}
        }
        None
    }

    fn start(&mut self, process: Process, joined: bool) {
        assert!(!self.fakes.contains_key(&process), "{process} is started twice");
        let mut fake = Fake::new(process, self.mode, &mut self.random, self.now);
        fake.joined = joined;
        self.order += 1;
        let serial = self.order;
        self.serials.insert(process, serial);
        let first = self.now + fake.turn_after(&mut self.random);
        self.fakes.insert(process, fake);
        self.plan(first, ScheduledEvent::Turn(process, serial));
    }

    fn deliver(&mut self, process: Process, command: Command) {
        match &command {
            Command::Evaluate(request) => {
                let version = request.policy_version;
                assert!(self.model.requests.contains(&version), "{version} was not requested");
                if !self.model.sent_requests.insert(version) {
                    self.tally.count("evaluations repeated");
                }
            }
            Command::EnvFailures { total } => {
                let expected = EARLIER_FAILURES + self.model.env_failures;
                assert_eq!(*total, expected, "failures sent to the learner");
            }
            Command::Sent(sent) => assert_eq!(*sent, self.model.sent, "segments sent"),
            _ => {}
        }
        if let Some(fake) = self.fakes.get_mut(&process) {
            fake.command(command);
        }
    }

    fn kill(&mut self, process: Process) {
        if self.immortal == Some(process) {
            return;
        }
        self.tally.count("kills");
        let Some(fake) = self.fakes.get(&process) else { return };
        let exit = if fake.joined { Output::Gone } else { Output::Exit(ExitStatus::from_raw(9)) };
        self.emit(process, vec![exit]);
    }

    /// Adds an event of the observer to the model.
    fn hear(&mut self, event: &RunEvent) {
        // Formatting must not panic.
        let _ = event.to_string();
        match event {
            RunEvent::Evaluated { row, .. } => {
                self.model.requests.remove(&row.policy_version);
                self.tally.count("answers");
            }
            RunEvent::NotEvaluated { policy_version, reason } => {
                assert!(self.model.requests.remove(policy_version), "{policy_version}");
                self.tally.count(match reason {
                    NotEvaluated::Failed { .. } => "evaluations failed",
                    NotEvaluated::TooFarBehind { .. } => "evaluations skipped",
                    NotEvaluated::LearnerDied => "evaluations given up with a learner",
                    NotEvaluated::Stopping => "evaluations given up with the run",
                });
            }
            RunEvent::ChildDied { process, death, next, .. } => {
                if !matches!(next, AfterDeath::Restart { .. }) {
                    self.model.given_up.insert(*process);
                    self.tally.count("workers given up");
                }
                if death.verb == "hung" {
                    self.tally.count(match process {
                        Process::Learner => "hangs of learners",
                        _ => "hangs",
                    });
                }
                self.tally.count(match process {
                    Process::Learner | Process::Relay => "deaths of learners",
                    Process::Actor(_) => "deaths of workers",
                    Process::Evaluator => "deaths of evaluators",
                    Process::Gateway => "deaths of gateways",
                });
            }
            RunEvent::Left { .. } => self.tally.count("left"),
            RunEvent::Draining { .. } => self.tally.count("drained"),
            _ => {}
        }
    }
}
