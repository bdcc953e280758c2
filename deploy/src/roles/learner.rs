//! The learner process: stages 5 to 7.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_learner::checkpoint;
use dmprl_learner::demonstrations::{Steps, Summary};
use dmprl_learner::learner::Learner;
use dmprl_learner::session::{Due, Session, Turn};
use dmprl_shared::config::DeliveryLevel;
use dmprl_shared::policy_file::{self, Match};
use dmprl_shared::segment::Rejection;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::{Replayed, SegmentLog};
use dmprl_shared::transport::shared_memory::{
    Acknowledger, LearnerEnd, Plan, Publisher, Receiver, serve,
};
use dmprl_shared::transport::{AcknowledgementPublisher, ParameterPublisher, SegmentReceiver};

use super::recorder::{Evaluate, Recorder};
use super::setup::Setup;
use super::{ControlPipe, LearnerArgs};
use crate::control::Report;
use crate::journal::{Author, Entry, Journal, Piece};

/// Sleep of a turn that found nothing to do: short beside a worker's segment of about 1 ms.
const IDLE: Duration = Duration::from_micros(100);
/// Between two cleanings of what dead workers left.
const MAINTENANCE_INTERVAL: Duration = Duration::from_millis(250);
/// Between two acknowledgements, at the latest.
const ACKNOWLEDGEMENT_INTERVAL: Duration = Duration::from_millis(10);
/// Environment steps after which the first segment is reported, on its own for the start-up time.
const FIRST: u64 = 1;

/// Serves the run's workers until the run is over or a stop is asked for.
pub fn run(args: &LearnerArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let setup = Setup::read(&args.run)?;
    let spec = setup.run.spec()?.context("the run has no spec.json; a worker writes it first")?;
    let mut learner = make(&setup, &spec, args, control)?;
    let journal = Journal::open(args.journal.as_deref(), Author::Learner(args.restarts))?;
    journal.iter().for_each(|journal| note_all(&mut learner, journal));
    recover(&mut learner, &setup, control)?;
    journal.iter().for_each(|journal| journal.note(Entry::Serving));
    let domain = args.domain.as_deref().context("--domain is missing")?;
    let plan = Plan::new(&setup.config, setup.run_id, learner.policy());
    let LearnerEnd { segments, parameters, acknowledgements } = serve(domain, &plan)?;
    let counters = &mut learner.counters;
    counters.policy_version = counters.policy_version.max(parameters.newest_version());
    counters.learner_restarts = counters.learner_restarts.max(args.restarts);
    let mut recorder = Recorder::new(&setup.run, control, &learner)?;
    recorder.note_in(journal);
    let mut session = Session::start(learner, segments, parameters)?;
    control.send(&Report::LearnerReady)?;
    // A supervisor that is gone is noticed as a stop, which ends with a checkpoint; a report that
    // it does not hear must not come before that.
    let mut ask = |request| {
        let _ = control.send(&Report::Evaluate(request));
        Ok(())
    };
    catch_up(&mut session, &mut recorder, &mut ask)?;
    let server = Server { session: &mut session, acknowledgements, control };
    let finished = server.turns(&mut recorder, &mut ask)?;
    if !finished {
        // What the workers had already sent is in the checkpoint; they are not waited for.
        let queued_max = plan.worker_count * plan.queue_segments;
        session.drain(&mut |_, _| Ok(()), queued_max)?;
    }
    let env_failures_before = session.learner.counters.env_failures;
    let env_failures = || env_failures_before.max(control.env_failures());
    let ending = Ending { finished, evaluate: &mut ask, env_failures: &env_failures };
    close(&mut session, &mut recorder, control, ending)
}

/// Notes where the learner begins and, from now on, every segment that comes.
fn note_all(learner: &mut Learner, journal: &Journal) {
    for (worker, mark) in (0..).zip(learner.inbox.settled()) {
        journal.note(Entry::Restored(worker, *mark));
    }
    journal.note(Entry::Started((&learner.counters).into()));
    let journal = journal.clone();
    learner.witness.0 = Some(Box::new(move |segment, inserted| {
        let piece = Piece::of(&segment.header, &segment.block);
        journal.note(match inserted {
            Ok(()) => Entry::Inserted(piece),
            Err(why) => Entry::Refused(piece, why == Rejection::Duplicate),
        });
    }));
}

/// At delivery level `log`, inserts what came after the checkpoint.
fn recover(learner: &mut Learner, setup: &Setup, control: &ControlPipe) -> anyhow::Result<()> {
    let delivery = &setup.config.delivery;
    if delivery.level == DeliveryLevel::Memory {
        return Ok(());
    }
    let path = setup.run.segment_log_path();
    let identity = (setup.run_id, learner.policy().architecture_hash());
    let layout = learner.policy().layout();
    let log = SegmentLog::open(&path, identity, layout, delivery.log_bytes_max);
    let replayed = log.and_then(|log| learner.recover(log));
    let replayed = replayed.with_context(|| format!("cannot use {}", path.display()))?;
    if replayed != Replayed::default() {
        let Replayed { records, cut_bytes } = replayed;
        let message = format!(
            "{records} segments read from the segment log, {cut_bytes} bytes of a torn one cut off"
        );
        eprintln!("{message}");
        control.send(&Report::Warning { message })?;
    }
    Ok(())
}

/// Evaluates what an earlier session was stopped before it had evaluated.
pub fn catch_up<R: SegmentReceiver, P: ParameterPublisher>(
    session: &mut Session<R, P>,
    recorder: &mut Recorder<'_>,
    evaluate: Evaluate<'_>,
) -> anyhow::Result<()> {
    if recorder.is_owed_an_evaluation(&session.learner) {
        session.publish()?;
        recorder.due(Due::Evaluation, &mut session.learner, evaluate)?;
    }
    Ok(())
}

/// Makes the learner: fresh, warm-started or from the newest usable checkpoint.
pub fn make(
    setup: &Setup,
    spec: &EnvSpec,
    args: &LearnerArgs,
    control: &ControlPipe,
) -> anyhow::Result<Learner> {
    let fresh = || Learner::new(setup.config.clone(), spec, setup.run_id);
    if args.resume {
        let (learner, loaded) = checkpoint::load_newest(&setup.run.checkpoints_path(), &fresh)?;
        for error in loaded.refused {
            let message = format!("a checkpoint is refused, an older one is used: {error}");
            eprintln!("{message}");
            control.send(&Report::Warning { message })?;
        }
        setup.run.rewind(learner.counters.env_steps)?;
        return Ok(learner);
    }
    let mut learner = fresh()?;
    if let Some(path) = &args.init_from {
        warm_start(&mut learner, path)?;
    }
    if !setup.config.demonstrations.files.is_empty() {
        let message = demonstrate(&mut learner, setup, spec)?;
        control.send(&Report::Warning { message })?;
    }
    Ok(learner)
}

/// Starts from the configuration's demonstrations; returns what is to be told about them.
fn demonstrate(learner: &mut Learner, setup: &Setup, spec: &EnvSpec) -> anyhow::Result<String> {
    let files = &setup.config.demonstrations.files;
    let read = |file| Steps::read(Path::new(file), spec, learner.policy());
    let demonstrations = files.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    let loss = learner.demonstrate(&demonstrations)?;
    let summaries = demonstrations.iter().map(Steps::summary);
    let all = summaries.fold(Summary::default(), |sum, more| Summary {
        episodes: sum.episodes + more.episodes,
        steps: sum.steps + more.steps,
        rewards: sum.rewards + more.rewards,
    });
    let mean = all.rewards / all.episodes as f64;
    let shown =
        format!("{} demonstrated steps in {} episodes, return {mean:.2}", all.steps, all.episodes);
    Ok(match loss {
        None => shown,
        Some((first, last)) => format!(
            "{shown}; the policy imitates them (mean squared error {first:.3}, then {last:.3})"
        ),
    })
}

fn warm_start(learner: &mut Learner, path: &Path) -> anyhow::Result<()> {
    let snapshot = policy_file::load(path, learner.policy(), Match::Sizes)
        .with_context(|| format!("cannot start from {}", path.display()))?;
    Ok(learner.warm_start(&snapshot.values)?)
}

/// A learner among its workers.
struct Server<'a> {
    session: &'a mut Session<Receiver, Publisher>,
    acknowledgements: Acknowledger,
    control: &'a ControlPipe,
}

impl Server<'_> {
    /// Takes turns until the run is finished (true) or a stop is asked for (false).
    fn turns(mut self, recorder: &mut Recorder<'_>, ask: Evaluate<'_>) -> anyhow::Result<bool> {
        let control = self.control;
        let (mut maintained, mut acknowledged) = (Instant::now(), Instant::now());
        let mut first = self.session.learner.counters.env_steps + FIRST;
        loop {
            self.hear();
            if control.stop_requested() {
                return Ok(false);
            }
            if control.finish_requested() {
                return Ok(true);
            }
            let mut due = |due: Due, learner: &mut Learner| {
                recorder.due(due, learner, ask).map_err(Into::into)
            };
            match self.session.turn(&mut due)? {
                Turn::Worked => {}
                Turn::Idle => std::thread::sleep(IDLE),
                Turn::Finished => return Ok(true),
            }
            if self.session.learner.counters.env_steps >= first {
                first = u64::MAX;
                let _ = control.send(&Report::FirstSegment);
            }
            let owed = self.session.learner.inbox.owes_acknowledgement();
            if owed || acknowledged.elapsed() >= ACKNOWLEDGEMENT_INTERVAL {
                if let Some(marks) = recorder.acknowledge(&mut self.session.learner) {
                    self.acknowledgements.acknowledge(marks)?;
                }
                acknowledged = Instant::now();
            }
            if maintained.elapsed() >= MAINTENANCE_INTERVAL {
                self.session.maintain()?;
                self.acknowledgements.maintain()?;
                maintained = Instant::now();
            }
            recorder.poll_checkpoint(&mut self.session.learner);
            recorder.progress(&self.session.learner);
        }
    }

    /// Takes over what was counted elsewhere. A checkpoint may know of more than the supervisor has
    /// told yet.
    fn hear(&mut self) {
        let counters = &mut self.session.learner.counters;
        counters.env_failures = counters.env_failures.max(self.control.env_failures());
        let workers = self.control.workers();
        counters.worker_restarts = counters.worker_restarts.max(workers.restarts);
        let sent = self.control.sent();
        if sent.produced >= counters.sent.produced {
            counters.sent = sent;
        }
    }
}

/// What the end of a session needs.
pub struct Ending<'a> {
    /// Whether the run has come to its own end; it was stopped otherwise.
    pub finished: bool,
    pub evaluate: Evaluate<'a>,
    /// Failures of environments so far: their number grows while the session ends.
    pub env_failures: &'a dyn Fn() -> u64,
}

/// Ends a session: the last evaluation if the run is finished, the last metrics and checkpoint.
pub fn close<R: SegmentReceiver, P: ParameterPublisher>(
    session: &mut Session<R, P>,
    recorder: &mut Recorder<'_>,
    control: &ControlPipe,
    ending: Ending<'_>,
) -> anyhow::Result<()> {
    let Ending { finished, evaluate, env_failures } = ending;
    let mut evaluation = Ok(());
    session.learner.counters.env_failures = env_failures();
    recorder.report_progress(&session.learner);
    if finished && recorder.is_unevaluated(&session.learner) {
        session.publish()?;
        // Whatever becomes of the evaluation, the checkpoint comes first.
        evaluation = recorder.due(Due::Evaluation, &mut session.learner, evaluate);
        // With one process, the evaluation is over by now, and what broke in it is known.
        session.learner.counters.env_failures = env_failures();
    }
    if recorder.is_unmeasured(&session.learner) {
        recorder.due(Due::Metrics, &mut session.learner, evaluate)?;
    }
    recorder.write_checkpoint(&mut session.learner);
    evaluation?;
    if control.orphaned() {
        bail!("the supervisor is gone; the run ended after a checkpoint");
    }
    control.send(&Report::Finished)
}
