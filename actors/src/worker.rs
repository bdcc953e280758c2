//! Stage 3 of 8, its loop: a worker's life, from its environments to its last report.
//!
//! The program around it reads the arguments, opens the conversation with the supervisor and makes
//! the environments ([`environments()`]). [`run`] does the rest: it reports the environments, waits
//! for the learner, then takes the newest policy, runs one segment in each environment and delivers
//! it, until a stop is requested.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use dmprl_shared::config::{ExperimentConfig, Hindsight};
use dmprl_shared::seeds;
use dmprl_shared::supervision::{Activity, Report, ReportError, Supervisor};
use dmprl_shared::transport::delivery::{Outbox, Sent};
use dmprl_shared::transport::shared_memory::Plan;
use dmprl_shared::transport::{WorkerEnd, WorkerTransport};
use thiserror::Error;

use crate::delivery::{ATTACH_LIMIT, ATTACH_PAUSE, Delivery, DeliveryError, Witness};
use crate::environments::{self, EnvironmentsError};
use crate::python_env::{Interpreter, PythonEnvironments};
use crate::rollout::{Identity, Rollout, RolloutError};

/// Maximum wait for acknowledgements of a worker that leaves a run that goes on.
const HAND_OVER_LIMIT: Duration = Duration::from_secs(5);

/// Why a worker ended early.
#[derive(Debug, Error)]
pub enum WorkerError {
    /// The environments or the policy failed.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// The learner cannot be reached.
    #[error(transparent)]
    Delivery(#[from] DeliveryError),
    /// The supervisor is gone.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// The learner is there, but has nothing to act with.
    #[error("worker {index}: the learner published no policy within {ATTACH_LIMIT:?}")]
    NoPolicy {
        /// The worker.
        index: u32,
    },
}

/// One worker of a run.
pub struct Worker<'a> {
    /// The experiment.
    pub config: &'a ExperimentConfig,
    /// Which worker of which run it is.
    pub identity: Identity,
    /// Its environments, made by [`environments()`].
    pub environments: PythonEnvironments,
    /// Called for everything that is produced, acknowledged or taken over.
    pub witness: Option<Witness>,
    /// Set for a worker that a user started beside a running training.
    pub guest: Option<Guest<'a>>,
}

/// What differs for a worker that joined a run.
pub struct Guest<'a> {
    /// Set once the worker was asked to leave a run that goes on.
    pub leaving: &'a AtomicBool,
    /// Called about once a second with what was sent so far.
    pub tell: &'a dyn Fn(Sent),
}

/// Seeds Python's generators and makes a worker's environments. `on_hang` is called if a call into
/// them does not return (see [`environments::watch`]). `stream` numbers the seeds: no two starts of
/// workers may share one.
///
/// # Errors
/// If the environments cannot be made or watched.
pub fn environments(
    interpreter: &Interpreter,
    config: &ExperimentConfig,
    stream: u64,
    on_hang: impl FnOnce(String) + Send + 'static,
) -> Result<PythonEnvironments, EnvironmentsError> {
    interpreter.seed(seeds::derive(config.run.seed, "python", stream))?;
    environments::make(interpreter, config, config.actors.envs_per_worker, on_hang)
}

/// Runs a worker until a stop is requested.
///
/// `attach` connects it to the learner that follows the same plan, or returns none if a stop is
/// requested first; in the program it is [`crate::delivery::await_learner`].
///
/// # Errors
/// Whatever keeps the worker from going on; a new process may help.
pub fn run<T: WorkerTransport>(
    worker: Worker<'_>,
    supervisor: &dyn Supervisor,
    attach: impl FnOnce(&Plan) -> Result<Option<WorkerEnd<T>>, DeliveryError>,
) -> Result<(), WorkerError> {
    let Worker { config, identity, environments, witness, guest } = worker;
    supervisor.report(&Report::EnvironmentReady { spec: environments.spec().clone() })?;
    if identity.seed_index == 0 && identity.incarnation == 0 {
        hint_at_hindsight(config, &environments, supervisor);
    }
    let mut rollout = Rollout::start(config, environments, identity)?;
    let plan = Plan::new(config, identity.run_id, rollout.policy());
    let Some(end) = attach(&plan)? else { return Ok(()) };
    let kept_max = config.delivery.unacknowledged_segments;
    let outbox = Outbox::new(plan.layout, kept_max, identity.worker_id, identity.incarnation);
    let deadline = Duration::from_secs_f64(config.actors.send_deadline_s);
    let mut delivery = Delivery::new(supervisor, deadline, end, outbox);
    delivery.set_witness(witness);
    await_first_policy(&mut delivery, &mut rollout, supervisor)?;
    work(&mut delivery, &mut rollout, supervisor, guest.as_ref())?;
    if guest.as_ref().is_some_and(|guest| guest.leaving.load(Ordering::Acquire)) {
        delivery.hand_over(HAND_OVER_LIMIT)?;
    }
    delivery.report()?;
    if let Some(guest) = &guest {
        (guest.tell)(delivery.sent());
    }
    Ok(())
}

/// Runs and delivers segments until a stop is requested.
fn work<T: WorkerTransport>(
    delivery: &mut Delivery<'_, T>,
    rollout: &mut Rollout,
    supervisor: &dyn Supervisor,
    guest: Option<&Guest<'_>>,
) -> Result<(), WorkerError> {
    while !supervisor.stop_requested() {
        supervisor.heartbeat(Activity::Stepping);
        delivery.take_newest_policy(&mut rollout.snapshot)?;
        let stepped = rollout.segment::<WorkerError>(&mut |header, block| {
            delivery.deliver(header, block).map_err(Into::into)
        });
        environments::report_failures(&rollout.take_failures(), supervisor);
        if delivery.report_in_time()?
            && let Some(guest) = guest
        {
            (guest.tell)(delivery.sent());
        }
        match stepped {
            Err(WorkerError::Delivery(DeliveryError::StopRequested)) => break,
            stepped => stepped?,
        }
    }
    Ok(())
}

/// Random exploration hardly ever reaches the goal of a sparse reward: names the setting that
/// helps, where it can be used.
fn hint_at_hindsight(
    config: &ExperimentConfig,
    environments: &PythonEnvironments,
    supervisor: &dyn Supervisor,
) {
    let is_off = config.replay.hindsight == Hindsight::None;
    if is_off && environments.goals().is_ok_and(|goals| goals.is_sparse) {
        let message = "the reward only says whether the goal is reached; --set \
                       replay.hindsight=future learns from goals reached by chance";
        supervisor.warn(message.to_owned());
    }
}

fn await_first_policy<T: WorkerTransport>(
    delivery: &mut Delivery<'_, T>,
    rollout: &mut Rollout,
    supervisor: &dyn Supervisor,
) -> Result<(), WorkerError> {
    let deadline = Instant::now() + ATTACH_LIMIT;
    while !delivery.take_newest_policy(&mut rollout.snapshot)? && !supervisor.stop_requested() {
        if Instant::now() >= deadline {
            return Err(WorkerError::NoPolicy { index: delivery.index() });
        }
        supervisor.heartbeat(Activity::Attaching);
        std::thread::sleep(ATTACH_PAUSE);
    }
    Ok(())
}
