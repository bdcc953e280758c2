//! The worker process: stage 3.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_actors::python_env::{Interpreter, InterpreterOptions, PythonEnvironments};
use dmprl_actors::rollout::{Identity, Rollout, RolloutError};
use dmprl_shared::config::{ExperimentConfig, Hindsight};
use dmprl_shared::seeds;
use dmprl_shared::segment::SegmentHeader;
use dmprl_shared::transport::delivery::{Acknowledgements, Outbox, Sent};
use dmprl_shared::transport::shared_memory::{Plan, WorkerEnd, attach};
use dmprl_shared::transport::{ParameterSubscriber, SendOutcome, TransportError};

use super::setup::Setup;
use super::{ActorArgs, ControlPipe, environments};
use crate::control::{Command, Report};

/// Sleep after the first offer of a segment to a full queue; doubles with each further one,
const FULL_QUEUE: Duration = Duration::from_micros(200);
/// up to this: a worker waits for milliseconds often, for longer at little cost. The segments that
/// still wait in the queue keep the learner busy for more.
const FULL_QUEUE_MAX: Duration = Duration::from_millis(3);
/// Sleep between two tries to attach, or looks for the first policy.
const ATTACH: Duration = Duration::from_millis(2);
/// A learner that is ready answers at once; longer means that it is gone.
const ATTACH_LIMIT: Duration = Duration::from_secs(30);
/// Between two reports of what was sent.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);
/// How long one look for a command may block, so that a stop is seen.
const COMMAND_WAIT: Duration = Duration::from_millis(100);

/// Starts the run's interpreter.
pub fn interpreter(venv: Option<&Path>, config: &ExperimentConfig) -> anyhow::Result<Interpreter> {
    let venv = venv.context("--venv is missing: the Python environment to run in")?;
    let python_path = config.task.python_path.iter().map(Into::into).collect();
    Ok(Interpreter::start(&InterpreterOptions { venv: venv.to_owned(), python_path })?)
}

/// Steps environments until a stop is asked for.
pub fn run(args: &ActorArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let setup = Setup::read(&args.run)?;
    let config = &setup.config;
    let interpreter = interpreter(args.venv.as_deref(), config)?;
    let worker = u64::from(args.index) << 32 | u64::from(args.incarnation);
    interpreter.seed(seeds::derive(config.run.seed, "python", worker))?;
    let envs = environments::make(&interpreter, config, config.actors.envs_per_worker, control)?;
    control.send(&Report::EnvironmentReady { spec: envs.spec().clone() })?;
    if args.index == 0 && args.incarnation == 0 {
        hint(config, &envs, control);
    }
    let identity =
        Identity { run_id: setup.run_id, worker_id: args.index, incarnation: args.incarnation };
    let mut rollout = Rollout::start(config, envs, identity)?;
    let plan = super::learner::plan(&setup, rollout.policy());
    let Some(end) = await_attach(control, &plan, args.index)? else { return Ok(()) };
    let kept = config.delivery.unacknowledged_segments;
    let outbox = Outbox::new(rollout.policy().layout(), kept, args.index, args.incarnation);
    let mut worker = Worker {
        index: args.index,
        control,
        deadline: Duration::from_secs_f64(config.actors.send_deadline_s),
        end,
        outbox,
        acknowledgements: Acknowledgements::default(),
        reported: Sent::default(),
        reported_at: Instant::now(),
    };
    worker.await_first_policy(&mut rollout)?;
    while !control.stop_requested() {
        worker.take_newest(&mut rollout)?;
        let stepped = rollout.segment(&mut |header, block| worker.deliver(header, block));
        environments::tell(&rollout.take_failures(), control);
        if worker.reported_at.elapsed() >= REPORT_INTERVAL {
            worker.report()?;
        }
        match stepped {
            Ok(()) => {}
            Err(Stopped::Asked) => break,
            Err(Stopped::Failed(error)) => return Err(error),
        }
    }
    worker.report()
}

/// A sparse reward is hardly ever met by chance: says what helps, where it can be had.
fn hint(config: &ExperimentConfig, envs: &PythonEnvironments, control: &ControlPipe) {
    let without = config.replay.hindsight == Hindsight::None;
    if without && envs.goals().is_ok_and(|goals| goals.is_sparse) {
        let message = "the reward only says whether the goal is reached; --set \
                       replay.hindsight=future learns from goals reached by chance";
        // A supervisor that is gone is noticed as a stop.
        let _ = control.send(&Report::Warning { message: message.to_owned() });
    }
}

fn await_attach(
    control: &ControlPipe,
    plan: &Plan,
    index: u32,
) -> anyhow::Result<Option<WorkerEnd>> {
    // The supervisor limits how long a start may take; here only a stop ends the wait.
    let domain = loop {
        if control.stop_requested() {
            return Ok(None);
        }
        if let Some(Command::Attach { domain }) = control.next_within(COMMAND_WAIT) {
            break domain;
        }
    };
    let deadline = Instant::now() + ATTACH_LIMIT;
    loop {
        match attach(&domain, plan, index as usize) {
            Ok(end) => return Ok(Some(end)),
            Err(error @ TransportError::Incompatible { .. }) => return Err(error.into()),
            Err(error) if Instant::now() >= deadline => {
                return Err(anyhow::Error::from(error).context(format!(
                    "worker {index} could not attach to the learner within {ATTACH_LIMIT:?}"
                )));
            }
            Err(_) if control.stop_requested() => return Ok(None),
            // The place of a killed predecessor is freed by the learner, a few times a second.
            Err(_) => std::thread::sleep(ATTACH),
        }
    }
}

/// Why a segment was not delivered.
enum Stopped {
    Asked,
    Failed(anyhow::Error),
}

impl From<RolloutError> for Stopped {
    fn from(error: RolloutError) -> Self {
        Self::Failed(error.into())
    }
}

impl From<anyhow::Error> for Stopped {
    fn from(error: anyhow::Error) -> Self {
        Self::Failed(error)
    }
}

struct Worker<'a> {
    index: u32,
    control: &'a ControlPipe,
    deadline: Duration,
    end: WorkerEnd,
    outbox: Outbox,
    /// The newest heard, a buffer.
    acknowledgements: Acknowledgements,
    /// What the supervisor knows of, and since when.
    reported: Sent,
    reported_at: Instant,
}

impl Worker<'_> {
    /// A damaged snapshot is reported and passed over; the next one comes soon.
    fn take_newest(&mut self, rollout: &mut Rollout) -> anyhow::Result<bool> {
        match self.end.parameters.newest(&mut rollout.snapshot) {
            Ok(taken) => Ok(taken),
            Err(TransportError::Snapshot(error)) => {
                eprintln!("a policy snapshot is refused: {error}");
                self.warn(format!("worker {} refused a policy snapshot: {error}", self.index));
                Ok(false)
            }
            Err(error) => Err(error.into()),
        }
    }

    fn await_first_policy(&mut self, rollout: &mut Rollout) -> anyhow::Result<()> {
        let deadline = Instant::now() + ATTACH_LIMIT;
        while !self.take_newest(rollout)? && !self.control.stop_requested() {
            if Instant::now() >= deadline {
                bail!(
                    "worker {}: the learner published no policy within {ATTACH_LIMIT:?}",
                    self.index
                );
            }
            std::thread::sleep(ATTACH);
        }
        Ok(())
    }

    /// Keeps a segment until the learner has acknowledged it, and offers it until a queue has taken
    /// it. Nothing is dropped: a full queue is how the learner slows its workers down.
    fn deliver(&mut self, header: &SegmentHeader, block: &[f32]) -> Result<(), Stopped> {
        let mut waiting: Option<(Instant, u32)> = None;
        let mut pause = FULL_QUEUE;
        let mut kept = false;
        loop {
            if 2 * self.outbox.len() >= self.outbox.capacity() {
                self.hear()?;
            }
            kept = kept || self.outbox.put(header, block);
            let outcome = self.outbox.offer(&mut self.end.segments);
            let outcome = outcome.map_err(|error| Stopped::Failed(error.into()))?;
            if kept && outcome == SendOutcome::Delivered {
                return Ok(());
            }
            if self.control.stop_requested() {
                return Err(Stopped::Asked);
            }
            let (since, told) = waiting.get_or_insert_with(|| (Instant::now(), 0));
            if since.elapsed() >= self.deadline * (*told + 1) {
                *told += 1;
                let seconds = since.elapsed().as_secs();
                let why = match outcome {
                    SendOutcome::Detached => "no learner is attached to its queue",
                    SendOutcome::Full => "the learner takes nothing from its full queue",
                    SendOutcome::Delivered => "the learner acknowledges nothing that it has taken",
                };
                self.warn(format!("worker {} has waited {seconds} s: {why}", self.index));
            }
            std::thread::sleep(pause);
            pause = (pause * 2).min(FULL_QUEUE_MAX);
        }
    }

    /// Forgets what the learner has acknowledged.
    fn hear(&mut self) -> anyhow::Result<()> {
        if self.end.acknowledgements.newest(&mut self.acknowledgements)? {
            self.outbox.acknowledge(&self.acknowledgements);
        }
        Ok(())
    }

    /// Tells the supervisor what was sent since the last time.
    fn report(&mut self) -> anyhow::Result<()> {
        self.hear()?;
        let sent = self.outbox.sent();
        // A supervisor that is gone is noticed as a stop.
        let _ = self.control.send(&Report::Sent(sent.since(&self.reported)));
        (self.reported, self.reported_at) = (sent, Instant::now());
        Ok(())
    }

    fn warn(&self, message: String) {
        eprintln!("warning: {message}");
        // A supervisor that is gone is noticed as a stop.
        let _ = self.control.send(&Report::Warning { message });
    }
}
