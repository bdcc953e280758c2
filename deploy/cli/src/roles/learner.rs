//! The learner's process: prepares run directory and journal for the loop in
//! `dmprl_learner::serve`.

use anyhow::Context;
use dmprl_chaos::journal::{Author, Entry, Journal, SegmentDigest};
use dmprl_learner::learner::{InsertObserver, Learner};
use dmprl_learner::recorder::Recorder;
use dmprl_learner::serve::Server;
use dmprl_learner::session::Session;
use dmprl_learner::start::{self, Origin, Run};
use dmprl_run::Setup;
use dmprl_shared::segment::Rejection;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::shared_memory::{LearnerEnd, Plan, serve};

use super::learner_files::{LearnerFiles, past};
use super::{ControlPipe, LearnerArgs};

/// Serves the run's workers until the run is complete or a stop is requested.
pub fn run(args: &LearnerArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let setup = Setup::read(&args.run)?;
    let spec = setup.run.spec()?.context("the run has no spec.json; a worker writes it first")?;
    let mut learner = make(&setup, &spec, args, control)?;
    let journal = Journal::open(args.journal.as_deref(), Author::Learner(args.restarts))?;
    journal.iter().for_each(|journal| note_all(&mut learner, journal));
    start::recover(&mut learner, setup.run_id, &setup.run.segment_log_path(), control)?;
    journal.iter().for_each(|journal| journal.note(Entry::Serving));
    let domain = args.domain.as_deref().context("--domain is missing")?;
    let plan = Plan::new(&setup.config, setup.run_id, learner.policy());
    let LearnerEnd { segments, parameters, acknowledgements } = serve(domain, &plan)?;
    let counters = &mut learner.counters;
    counters.policy_version = counters.policy_version.max(parameters.newest_version());
    counters.learner_restarts = counters.learner_restarts.max(args.restarts);
    let mut files = LearnerFiles::open(&setup.run, journal)?;
    let recorder = Recorder::new(&mut files, past(&setup.run)?, control, &learner);
    let server = Server {
        session: Session::start(learner, segments, parameters)?,
        acknowledgements,
        queued_segments_max: plan.worker_count * plan.queue_segments,
        recorder,
        supervisor: control,
    };
    Ok(server.run()?)
}

/// Writes the learner's initial state to the journal and, from now on, every segment that arrives.
fn note_all(learner: &mut Learner, journal: &Journal) {
    for (worker, mark) in (0..).zip(learner.inbox.settled()) {
        journal.note(Entry::Restored(worker, *mark));
    }
    journal.note(Entry::Started((&learner.counters).into()));
    let journal = journal.clone();
    learner.insert_observer = InsertObserver::new(move |segment, inserted| {
        let digest = SegmentDigest::of(&segment.header, &segment.block);
        journal.note(match inserted {
            Ok(()) => Entry::Inserted(digest),
            Err(why) => {
                Entry::Rejected { segment: digest, is_duplicate: why == Rejection::Duplicate }
            }
        });
    });
}

/// Creates the learner that the arguments describe. For a resumed run, removes evaluation rows that
/// are newer than the checkpoint.
pub fn make(
    setup: &Setup,
    spec: &EnvSpec,
    args: &LearnerArgs,
    control: &ControlPipe,
) -> anyhow::Result<Learner> {
    let checkpoints = setup.run.checkpoints_path();
    let origin = match args.resume {
        true => Origin::Checkpoint(&checkpoints),
        false => Origin::New(args.init_from.as_deref()),
    };
    let run = Run { config: &setup.config, spec, run_id: setup.run_id };
    let learner = start::learner(run, origin, control)?;
    if args.resume {
        setup.run.rewind(learner.counters.env_steps)?;
    }
    Ok(learner)
}
