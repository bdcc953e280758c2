//! The worker's process: prepares interpreter, environments and journal for the loop in
//! `dmprl_actors::worker`.

use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use dmprl_actors::delivery::{self, DeliveryEvent, DeliveryObserver};
use dmprl_actors::environments::interpreter;
use dmprl_actors::python_env::Interpreter;
use dmprl_actors::rollout::Identity;
use dmprl_actors::worker::{self, JoinedWorker, Worker};
use dmprl_chaos::journal::{Author, Entry, Journal, SegmentDigest};
use dmprl_control::{ControlPipe, start_heartbeat};
use dmprl_run::Setup;
use dmprl_shared::config::ExperimentConfig;

use super::ActorArgs;
use super::environments::on_hang;

/// Starts the run's interpreter.
pub fn start_interpreter(
    venv: Option<&Path>,
    config: &ExperimentConfig,
) -> anyhow::Result<Interpreter> {
    let venv = venv.context("--venv is missing: the Python environment to run in")?;
    Ok(interpreter(venv, config)?)
}

/// Which worker of which run to run.
pub struct WorkerStart<'a> {
    pub setup: &'a Setup,
    pub index: u32,
    /// Index in the run of this host's first worker.
    pub first: u32,
    pub incarnation: u32,
    pub venv: Option<&'a Path>,
    /// Folder of the journal, for `dmprl chaos`.
    pub journal: Option<&'a Path>,
}

/// Runs the worker that the arguments name, until a stop is requested.
pub fn run(args: &ActorArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let setup = Setup::read(args.run.as_deref().context("--run is missing")?)?;
    let index = args.index.context("--index is missing")?;
    let (incarnation, venv) = (args.incarnation, args.venv.as_deref());
    let journal = args.journal.as_deref();
    let first = args.first;
    work(&WorkerStart { setup: &setup, index, first, incarnation, venv, journal }, control, None)
}

/// Runs a worker until a stop is requested. `joined` is set if a user started it.
pub fn work(
    start: &WorkerStart<'_>,
    control: &ControlPipe,
    joined: Option<JoinedWorker<'_>>,
) -> anyhow::Result<()> {
    let WorkerStart { setup, index, first, incarnation, venv, journal } = *start;
    let config = &setup.config;
    let seed_index = first + index;
    let identity = Identity { run_id: setup.run_id, worker_id: index, incarnation, seed_index };
    let interpreter = start_interpreter(venv, config)?;
    let environments =
        worker::environments(&interpreter, config, identity.stream(), on_hang(control))?;
    start_heartbeat(control, {
        let calls = Arc::downgrade(environments.calls());
        move || calls.upgrade().map(|calls| calls.is_running())
    })?;
    let observer = Journal::open(journal, Author::Worker(index, incarnation))?.map(note_in);
    let worker = Worker { config, identity, environments, observer, joined };
    let attach = |plan: &_| delivery::await_learner(control, plan, index);
    Ok(worker::run(worker, control, attach)?)
}

/// Writes each event of the delivery to a journal.
fn note_in(journal: Journal) -> DeliveryObserver {
    Box::new(move |event| {
        journal.note(match event {
            DeliveryEvent::Produced { header, block } => {
                Entry::Produced(SegmentDigest::of(header, block))
            }
            DeliveryEvent::Acknowledged(mark) => Entry::Acknowledged(mark),
            DeliveryEvent::PolicyTaken { epoch, version } => Entry::Policy { epoch, version },
        });
    })
}
