use std::io;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

use dmprl_shared::config::Layers;
use dmprl_shared::segment::{
    LAYOUT_VERSION, Segment, SegmentHeader, SegmentLayout, TRUNCATED, block_checksum,
};
use dmprl_shared::supervision::{FakeSupervisor, RunTotals, WorkersNow};
use dmprl_shared::transport::delivery::Sent;
use dmprl_shared::transport::in_process::{
    AcknowledgementReader, Acknowledger, Publisher, Receiver, Sender, acknowledgement_channel,
    parameter_channel, segment_queues,
};
use dmprl_shared::transport::{AcknowledgementSubscriber, SegmentSender, SendOutcome};
use tempfile::TempDir;

use super::*;
use crate::checkpoint;
use crate::learner::Counters;
use crate::learner::tests::spec;
use crate::recorder::{PreviousSessions, RunFiles};

const QUEUE_SEGMENTS: usize = 8;
const RUN_ID: u64 = 1;

/// Keeps metrics and policies in memory, and checkpoints in a folder.
struct Files {
    folder: TempDir,
    metrics: Vec<String>,
    policies: Vec<u64>,
}

impl RunFiles for Files {
    fn append_metrics(&mut self, line: &[u8]) -> io::Result<()> {
        self.metrics.push(String::from_utf8(line.to_vec()).unwrap());
        Ok(())
    }

    fn save_policy(&mut self, version: u64, _bytes: &[u8]) -> Result<(), DueError> {
        self.policies.push(version);
        Ok(())
    }

    fn checkpoints(&self) -> PathBuf {
        self.folder.path().to_owned()
    }

    fn checkpoint_begins(&mut self, _counters: &Counters) {}
}

impl Files {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap(), metrics: Vec::new(), policies: Vec::new() }
    }

    /// Returns the counters of the only checkpoint.
    fn checkpoint(&self) -> Counters {
        let counters = checkpoint::counters(self.folder.path()).unwrap();
        assert_eq!(counters.len(), 1);
        counters[0]
    }
}

/// A learner and the transport of its only worker.
struct Run {
    session: Session<Receiver, Publisher>,
    acknowledger: Acknowledger,
    sender: Sender,
    acknowledgements: AcknowledgementReader,
    layout: SegmentLayout,
    architecture_hash: u64,
}

impl Run {
    fn new() -> Self {
        let mut layers = Layers::new();
        for (key, value) in [
            ("policy.hidden", "[8]"),
            ("algorithm.critic_hidden", "[8]"),
            ("algorithm.batch_size", "8"),
            ("replay.capacity_steps", "1000"),
            ("exploration.warm_up_steps", "1000"),
            ("actors.workers", "1"),
            ("run.steps", "2000"),
        ] {
            layers.set("test", key, value).unwrap();
        }
        let learner = Learner::new(layers.finish().unwrap(), &spec(), RUN_ID).unwrap();
        let layout = learner.policy().layout();
        let architecture_hash = learner.policy().architecture_hash();
        let workers = learner.config().places();
        let (mut senders, receiver) = segment_queues(workers, QUEUE_SEGMENTS, layout);
        let (publisher, _) = parameter_channel(architecture_hash);
        let (acknowledger, acknowledgements) = acknowledgement_channel(workers);
        let session = Session::start(learner, receiver, publisher).unwrap();
        let sender = senders.remove(0);
        Self { session, acknowledger, sender, acknowledgements, layout, architecture_hash }
    }

    fn send(&mut self, run_id: u64, sequence: u64) {
        let mut segment = Segment::zeroed(self.layout);
        segment.header = SegmentHeader {
            layout_version: LAYOUT_VERSION,
            flags: TRUNCATED,
            run_id,
            architecture_hash: self.architecture_hash,
            sequence,
            episode: sequence as u32,
            steps_len: 5,
            segment_steps: self.layout.segment_steps as u32,
            observation_len: self.layout.observation_len as u32,
            action_len: self.layout.action_len as u32,
            checksum: block_checksum(&segment.block),
            ..SegmentHeader::default()
        };
        let outcome = self.sender.try_send(&segment.header, &segment.block).unwrap();
        assert_eq!(outcome, SendOutcome::Delivered);
    }

    fn serve(
        self,
        files: &mut Files,
        supervisor: &FakeSupervisor,
    ) -> (AcknowledgementReader, Result<(), ServeError>) {
        let recorder =
            Recorder::new(files, PreviousSessions::default(), supervisor, &self.session.learner);
        let server = Server {
            session: self.session,
            acknowledgements: self.acknowledger,
            queued_segments_max: QUEUE_SEGMENTS,
            recorder,
            supervisor,
        };
        (self.acknowledgements, server.run())
    }
}

fn stops_after_the_first_segment() -> FakeSupervisor {
    FakeSupervisor::stopping_on(|report| *report == Report::FirstSegment)
}

#[test]
fn a_stop_leads_to_a_checkpoint_of_what_was_queued_and_a_final_report() {
    let (mut run, mut files) = (Run::new(), Files::new());
    (1..=3).for_each(|sequence| run.send(RUN_ID, sequence));
    let supervisor = stops_after_the_first_segment();
    let (_, ended) = run.serve(&mut files, &supervisor);
    ended.unwrap();
    let name = "000001".to_owned();
    let reports = supervisor.reports();
    let (first, last) = (&reports[..2], &reports[reports.len() - 2..]);
    assert_eq!(first, [Report::LearnerReady, Report::FirstSegment]);
    assert_eq!(last, [Report::Checkpoint { name, env_steps: 15 }, Report::Finished]);
    let counters = files.checkpoint();
    assert_eq!((counters.segments, counters.env_steps, counters.updates), (3, 15, 0));
    // A stopped run is not evaluated.
    assert_eq!((files.metrics.len(), files.policies.len()), (1, 0));
    assert_eq!(supervisor.warnings(), Vec::<String>::new());
}

#[test]
fn a_run_that_must_finish_asks_for_a_last_evaluation_before_its_checkpoint() {
    let (run, mut files, supervisor) = (Run::new(), Files::new(), FakeSupervisor::default());
    supervisor.finish.store(true, Ordering::Release);
    let (_, ended) = run.serve(&mut files, &supervisor);
    ended.unwrap();
    let reports = supervisor.reports();
    let kinds: Vec<&str> = reports
        .iter()
        .map(|report| match report {
            Report::LearnerReady => "ready",
            Report::Progress(_) => "progress",
            Report::Evaluate(request) if files.policies == [request.policy_version] => "evaluate",
            Report::Checkpoint { .. } => "checkpoint",
            Report::Finished => "finished",
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(kinds, ["ready", "progress", "evaluate", "checkpoint", "finished"]);
}

#[test]
fn the_first_refused_segment_of_a_kind_is_a_warning_and_the_others_are_counted() {
    let (mut run, mut files) = (Run::new(), Files::new());
    (1..=3).for_each(|sequence| run.send(RUN_ID + 1, sequence));
    run.send(RUN_ID, 1);
    let supervisor = stops_after_the_first_segment();
    let (_, ended) = run.serve(&mut files, &supervisor);
    ended.unwrap();
    let warnings = supervisor.warnings();
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    assert!(warnings[0].contains("a segment was rejected"), "{warnings:?}");
    let counters = files.checkpoint();
    assert_eq!((counters.rejected.run, counters.segments), (3, 1));
}

#[test]
fn the_totals_of_the_supervisor_are_in_the_checkpoint() {
    let (run, mut files, supervisor) = (Run::new(), Files::new(), FakeSupervisor::default());
    supervisor.set_totals(RunTotals {
        env_failures: 4,
        workers: WorkersNow { restarts: 2, ..WorkersNow::default() },
        sent: Sent { produced: 9, ..Sent::default() },
    });
    supervisor.finish.store(true, Ordering::Release);
    run.serve(&mut files, &supervisor).1.unwrap();
    let counters = files.checkpoint();
    let counted = (counters.env_failures, counters.worker_restarts, counters.sent.produced);
    assert_eq!(counted, (4, 2, 9));
}

#[test]
fn a_learner_acknowledges_what_it_has_inserted() {
    let (mut run, mut files) = (Run::new(), Files::new());
    (1..=3).for_each(|sequence| run.send(RUN_ID, sequence));
    // The run ends at its first progress report, after several acknowledgements.
    let supervisor = FakeSupervisor::stopping_on(|report| matches!(report, Report::Progress(_)));
    let (mut reader, ended) = run.serve(&mut files, &supervisor);
    ended.unwrap();
    let mut acknowledgements = Default::default();
    assert!(AcknowledgementSubscriber::newest(&mut reader, &mut acknowledgements).unwrap());
    assert_eq!(acknowledgements.marks[0].sequence, 3);
}

#[test]
fn a_learner_without_a_supervisor_fails_after_its_checkpoint() {
    let (run, mut files, supervisor) = (Run::new(), Files::new(), FakeSupervisor::default());
    let Run { session, acknowledger, .. } = run;
    let mut session = session;
    supervisor.gone.store(true, Ordering::Release);
    let mut recorder =
        Recorder::new(&mut files, PreviousSessions::default(), &supervisor, &session.learner);
    let mut evaluate = |_| Ok(());
    let ending = SessionEnd { is_complete: false, evaluate: &mut evaluate, env_failures: &|| 0 };
    let error = close(&mut session, &mut recorder, &supervisor, ending).unwrap_err();
    assert!(matches!(error, ServeError::SupervisorGone), "{error}");
    drop((recorder, acknowledger));
    assert_eq!(files.checkpoint().segments, 0);
}
