//! Stage 3 of 8, the worker's loop, from its environments to its last report.
//!
//! The program `dmprl` reads the arguments, connects to the supervisor and creates the environments
//! ([`environments()`]). [`run`] reports the environments and waits for the learner. Then it takes
//! the newest policy, runs one segment in each environment and delivers it, until a stop is
//! requested.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::seeds;
use dmprl_shared::supervision::{Activity, Report, ReportError, Supervisor};
use dmprl_shared::transport::delivery::{Outbox, Sent};
use dmprl_shared::transport::shared_memory::Plan;
use dmprl_shared::transport::{WorkerEnd, WorkerTransport};
use thiserror::Error;

use crate::delivery::{ATTACH_LIMIT, ATTACH_PAUSE, Delivery, DeliveryError, DeliveryObserver};
use crate::environments::{self, EnvironmentsError};
use crate::hindsight_note::{GoalRewards, hindsight_note};
use crate::python_env::{Interpreter, PythonEnvironments};
use crate::rollout::{Identity, Rollout, RolloutError};

/// Maximum wait for acknowledgements when a worker leaves a run that continues.
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
    /// The learner is running, but has not published a policy.
    #[error("worker {index}: the learner published no policy within {ATTACH_LIMIT:?}")]
    NoPolicy {
        /// The worker.
        index: u32,
    },
}

/// One worker of a run.
pub struct Worker<'a> {
    /// The run's configuration.
    pub config: &'a ExperimentConfig,
    /// The worker's identity in the run.
    pub identity: Identity,
    /// Its environments, created by [`environments()`].
    pub environments: PythonEnvironments,
    /// Called synchronously at each event of its delivery.
    pub observer: Option<DeliveryObserver>,
    /// Set for a worker that joined a running training.
    pub joined: Option<JoinedWorker<'a>>,
}

/// Connects a worker that joined a run to the program that the user started.
pub struct JoinedWorker<'a> {
    /// Set when the user makes the worker leave the run.
    pub leaving: &'a AtomicBool,
    /// Called about once per second with the counts so far.
    pub report_sent: &'a dyn Fn(Sent),
}

/// Seeds Python's generators and creates a worker's environments.
///
/// - `stream`: as [`Identity::stream`], from which the seed is derived.
/// - `on_hang`: called if a call into the environments does not return (see
///   [`environments::watch`]).
///
/// # Errors
/// If the environments cannot be created or watched.
pub fn environments(
    interpreter: &Interpreter,
    config: &ExperimentConfig,
    stream: u64,
    on_hang: impl FnOnce(String) + Send + 'static,
) -> Result<PythonEnvironments, EnvironmentsError> {
    interpreter.seed(seeds::derive(config.run.seed, "python", stream))?;
    let (envs, steps) = (config.actors.envs_per_worker, config.policy.decision_steps());
    environments::make(interpreter, config, envs, steps, on_hang)
}

/// Runs a worker until a stop is requested.
///
/// `attach` connects it to the learner with the same plan, or returns `None` if a stop is requested
/// first; the program uses [`crate::delivery::await_learner`].
///
/// # Errors
/// If the environments, the transport or the supervisor fail. A new process may succeed.
pub fn run<T: WorkerTransport>(
    worker: Worker<'_>,
    supervisor: &dyn Supervisor,
    attach: impl FnOnce(&Plan) -> Result<Option<WorkerEnd<T>>, DeliveryError>,
) -> Result<(), WorkerError> {
    let Worker { config, identity, environments, observer, joined } = worker;
    supervisor.report(&Report::EnvironmentReady { spec: environments.spec().clone() })?;
    if identity.seed_index == 0 && identity.incarnation == 0 {
        report_hindsight(config, &environments, supervisor);
    }
    let mut rollout = Rollout::start(config, environments, identity)?;
    let plan = Plan::new(config, identity.run_id, rollout.policy());
    let Some(end) = attach(&plan)? else { return Ok(()) };
    let kept_max = config.delivery.unacknowledged_segments;
    let outbox = Outbox::new(plan.layout, kept_max, identity.worker_id, identity.incarnation);
    let deadline = Duration::from_secs_f64(config.actors.send_deadline_s);
    let mut delivery = Delivery::new(supervisor, deadline, end, outbox);
    delivery.set_observer(observer);
    await_first_policy(&mut delivery, &mut rollout, supervisor)?;
    work(&mut delivery, &mut rollout, supervisor, joined.as_ref())?;
    if joined.as_ref().is_some_and(|joined| joined.leaving.load(Ordering::Acquire)) {
        delivery.hand_over(HAND_OVER_LIMIT)?;
    }
    delivery.report()?;
    if let Some(joined) = &joined {
        (joined.report_sent)(delivery.sent());
    }
    Ok(())
}

/// Runs and delivers segments until a stop is requested.
fn work<T: WorkerTransport>(
    delivery: &mut Delivery<'_, T>,
    rollout: &mut Rollout,
    supervisor: &dyn Supervisor,
    joined: Option<&JoinedWorker<'_>>,
) -> Result<(), WorkerError> {
    while !supervisor.stop_requested() {
        supervisor.heartbeat(Activity::Stepping);
        delivery.take_newest_policy(&mut rollout.snapshot)?;
        let stepped = rollout.segment::<WorkerError>(&mut |header, block| {
            delivery.deliver(header, block).map_err(Into::into)
        });
        environments::report_failures(&rollout.take_failures(), supervisor);
        if delivery.report_in_time()?
            && let Some(joined) = joined
        {
            (joined.report_sent)(delivery.sent());
        }
        match stepped {
            Err(WorkerError::Delivery(DeliveryError::StopRequested)) => break,
            stepped => stepped?,
        }
    }
    Ok(())
}

/// Tells the user how the run learns from goals, if there is something to tell.
fn report_hindsight(
    config: &ExperimentConfig,
    environments: &PythonEnvironments,
    supervisor: &dyn Supervisor,
) {
    let rewards = match (environments.spec().goal_rule.as_deref(), environments.missing_rule()) {
        (Some(rule), _) => GoalRewards::Rule(rule),
        (None, Some(reason)) => GoalRewards::NoRule(reason),
        (None, None) => GoalRewards::NoHindsight {
            is_sparse: environments.goals().is_ok_and(|goals| goals.is_sparse),
        },
    };
    if let Some(note) = hindsight_note(config, rewards) {
        supervisor.warn(note);
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
