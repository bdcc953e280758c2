//! The worker process: stage 3.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_actors::python_env::{Interpreter, InterpreterOptions, PythonEnvironments};
use dmprl_actors::rollout::{Identity, Rollout, RolloutError};
use dmprl_shared::config::{ExperimentConfig, Hindsight};
use dmprl_shared::seeds;
use dmprl_shared::transport::TransportError;
use dmprl_shared::transport::delivery::{Outbox, Sent};
use dmprl_shared::transport::shared_memory::{Plan, WorkerEnd};

use super::delivery::{ATTACH, ATTACH_LIMIT, Delivery, Stopped, attach_within};
use super::setup::Setup;
use super::{ActorArgs, ControlPipe, environments, heartbeat};
use crate::control::{Command, Doing, Report};
use crate::journal::{Author, Journal};

/// How long one look for a command may block, so that a stop is seen.
const COMMAND_WAIT: Duration = Duration::from_millis(100);
/// One that leaves a run that goes on waits so long for its acknowledgements.
const HAND_OVER: Duration = Duration::from_secs(5);

/// Starts the run's interpreter.
pub fn interpreter(venv: Option<&Path>, config: &ExperimentConfig) -> anyhow::Result<Interpreter> {
    let venv = venv.context("--venv is missing: the Python environment to run in")?;
    let python_path = config.task.python_path.iter().map(Into::into).collect();
    Ok(Interpreter::start(&InterpreterOptions { venv: venv.to_owned(), python_path })?)
}

/// Which worker of which run.
pub struct Seat<'a> {
    pub setup: &'a Setup,
    pub index: u32,
    /// Which of the run's workers the first of this host is.
    pub first: u32,
    pub incarnation: u32,
    pub venv: Option<&'a Path>,
    /// Where everything that is sent is noted, for `dmprl chaos`.
    pub journal: Option<&'a Path>,
}

/// What is different for a worker that joined by somebody else's doing.
pub struct Guest<'a> {
    /// Set when it was asked to leave a run that goes on.
    pub leaving: &'a AtomicBool,
    /// Told about once a second what was sent.
    pub tell: &'a mut dyn FnMut(Sent),
}

/// Steps environments until a stop is asked for.
pub fn run(args: &ActorArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let setup = Setup::read(args.run.as_deref().context("--run is missing")?)?;
    let index = args.index.context("--index is missing")?;
    let (incarnation, venv) = (args.incarnation, args.venv.as_deref());
    let journal = args.journal.as_deref();
    let first = args.first;
    work(&Seat { setup: &setup, index, first, incarnation, venv, journal }, control, None)
}

/// Steps environments until a stop is asked for.
pub fn work(
    seat: &Seat<'_>,
    control: &ControlPipe,
    mut guest: Option<Guest<'_>>,
) -> anyhow::Result<()> {
    let Seat { setup, index, first, incarnation, venv, journal } = *seat;
    let config = &setup.config;
    let interpreter = interpreter(venv, config)?;
    let seed_index = first + index;
    let worker = u64::from(seed_index) << 32 | u64::from(incarnation);
    interpreter.seed(seeds::derive(config.run.seed, "python", worker))?;
    let envs = environments::make(&interpreter, config, config.actors.envs_per_worker, control)?;
    heartbeat::start(control, envs.calls())?;
    control.send(&Report::EnvironmentReady { spec: envs.spec().clone() })?;
    if seed_index == 0 && incarnation == 0 {
        hint(config, &envs, control);
    }
    let identity = Identity { run_id: setup.run_id, worker_id: index, incarnation, seed_index };
    let mut rollout = Rollout::start(config, envs, identity)?;
    let plan = super::learner::plan(setup, rollout.policy());
    let Some(end) = await_attach(control, &plan, index)? else { return Ok(()) };
    let kept = config.delivery.unacknowledged_segments;
    let outbox = Outbox::new(rollout.policy().layout(), kept, index, incarnation);
    let deadline = Duration::from_secs_f64(config.actors.send_deadline_s);
    let mut delivery = Delivery::new(control, deadline, end, outbox);
    delivery.note_in(Journal::open(journal, Author::Worker(index, incarnation))?);
    await_first_policy(&mut delivery, &mut rollout, control)?;
    while !control.stop_requested() {
        control.beat(Doing::Stepping);
        take_newest(&mut delivery, &mut rollout)?;
        let stepped = rollout.segment(&mut |header, block| delivery.deliver(header, block));
        environments::tell(&rollout.take_failures(), control);
        if delivery.report_in_time()?
            && let Some(guest) = &mut guest
        {
            (guest.tell)(delivery.sent());
        }
        match stepped {
            Ok(()) => {}
            Err(Stopped::Asked) => break,
            Err(Stopped::Failed(error)) => return Err(error),
        }
    }
    if guest.as_ref().is_some_and(|guest| guest.leaving.load(Ordering::Acquire)) {
        delivery.hand_over(HAND_OVER)?;
    }
    delivery.report()?;
    if let Some(guest) = &mut guest {
        (guest.tell)(delivery.sent());
    }
    Ok(())
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
    loop {
        if control.stop_requested() {
            return Ok(None);
        }
        control.beat(Doing::Attaching);
        if let Some(Command::Attach { domain }) = control.next_within(COMMAND_WAIT) {
            return attach_within(control, (&domain, plan), index);
        }
    }
}

/// A damaged snapshot is reported and passed over; the next one comes soon.
fn take_newest(delivery: &mut Delivery<'_>, rollout: &mut Rollout) -> anyhow::Result<bool> {
    match delivery.newest_policy(&mut rollout.snapshot) {
        Ok(taken) => Ok(taken),
        Err(TransportError::Snapshot(error)) => {
            eprintln!("a policy snapshot is refused: {error}");
            let index = delivery.index();
            delivery.warn(format!("worker {index} refused a policy snapshot: {error}"));
            Ok(false)
        }
        Err(error) => Err(error.into()),
    }
}

fn await_first_policy(
    delivery: &mut Delivery<'_>,
    rollout: &mut Rollout,
    control: &ControlPipe,
) -> anyhow::Result<()> {
    let deadline = Instant::now() + ATTACH_LIMIT;
    while !take_newest(delivery, rollout)? && !control.stop_requested() {
        if Instant::now() >= deadline {
            bail!(
                "worker {}: the learner published no policy within {ATTACH_LIMIT:?}",
                delivery.index()
            );
        }
        control.beat(Doing::Attaching);
        std::thread::sleep(ATTACH);
    }
    Ok(())
}

impl From<RolloutError> for Stopped {
    fn from(error: RolloutError) -> Self {
        Self::Failed(error.into())
    }
}
