//! The loops of worker and evaluator with real environments in this process. The supervisor is a
//! fake, and the test has the learner's end of the transport.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::sync::OnceLock;
use std::sync::atomic::Ordering;

use dmprl_actors::evaluator::{self, Evaluations};
use dmprl_actors::python_env::Interpreter;
use dmprl_actors::rollout::Identity;
use dmprl_actors::worker::{self, Worker, WorkerError};
use dmprl_actors::{delivery::DeliveryError, environments};
use dmprl_shared::config::{ExperimentConfig, Layers};
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::policy_file;
use dmprl_shared::segment::Segment;
use dmprl_shared::supervision::{Activity, Command, EvaluationRequest, FakeSupervisor, Report};
use dmprl_shared::transport::delivery::Sent;
use dmprl_shared::transport::in_process::{self, InProcess};
use dmprl_shared::transport::shared_memory::Plan;
use dmprl_shared::transport::{ParameterPublisher, SegmentReceiver, WorkerEnd};
use dmprl_tests::{tiny_envs_dir, venv};

const ENVS: usize = 2;
const IDENTITY: Identity = Identity { run_id: 1, worker_id: 0, incarnation: 0, seed_index: 0 };

fn config() -> ExperimentConfig {
    let mut layers = Layers::new();
    for (key, value) in [
        ("task.id", "tiny_envs:Long-v0"),
        ("actors.envs_per_worker", "2"),
        ("actors.workers", "1"),
        ("actors.queue_segments", "16"),
        ("delivery.unacknowledged_segments", "32"),
        ("policy.hidden", "[8]"),
        ("evaluation.episodes", "3"),
    ] {
        layers.set("test", key, value).unwrap();
    }
    let mut config = layers.finish().unwrap();
    config.task.python_path = vec![tiny_envs_dir().to_str().unwrap().to_owned()];
    config
}

fn interpreter() -> &'static Interpreter {
    static INTERPRETER: OnceLock<Interpreter> = OnceLock::new();
    INTERPRETER.get_or_init(|| environments::interpreter(&venv().venv, &config()).unwrap())
}

/// The learner's ends of the transport.
struct Learner {
    segments: in_process::Receiver,
    parameters: in_process::Publisher,
}

/// Attaches a worker to a learner that has published these policies.
fn attach(
    plan: &Plan,
    published: &[ParameterSnapshot],
    learner: &mut Option<Learner>,
) -> WorkerEnd<InProcess> {
    let (mut senders, receiver) =
        in_process::segment_queues(plan.worker_count, plan.queue_segments, plan.layout);
    let (publisher, parameters) = in_process::parameter_channel(plan.architecture_hash);
    let (_, acknowledgements) = in_process::acknowledgement_channel(plan.worker_count);
    let ends = learner.insert(Learner { segments: receiver, parameters: publisher });
    for snapshot in published {
        ends.parameters.publish(snapshot).unwrap();
    }
    WorkerEnd { segments: senders.remove(0), parameters, acknowledgements }
}

fn snapshot(plan: &Plan, architecture_hash: u64) -> ParameterSnapshot {
    ParameterSnapshot {
        version: 1,
        architecture_hash,
        values: vec![0.0; plan.parameters_len],
        ..ParameterSnapshot::default()
    }
}

fn worker(config: &ExperimentConfig) -> Worker<'_> {
    let environments =
        worker::environments(interpreter(), config, IDENTITY.stream(), |_| ()).unwrap();
    Worker { config, identity: IDENTITY, environments, observer: None, joined: None }
}

/// A connector that attaches to nothing.
fn without_learner(_: &Plan) -> Result<Option<WorkerEnd<InProcess>>, DeliveryError> {
    Ok(None)
}

/// Runs a worker; returns the sequence numbers that the learner's queue holds afterwards.
fn run(
    supervisor: &FakeSupervisor,
    published: impl Fn(&Plan) -> ParameterSnapshot,
) -> (Vec<u64>, Result<(), WorkerError>) {
    let config = config();
    let mut learner = None;
    let ended = worker::run(worker(&config), supervisor, |plan: &Plan| {
        Ok(Some(attach(plan, &[published(plan)], &mut learner)))
    });
    let mut sequences = Vec::new();
    let mut segment = Segment::default();
    while learner.as_mut().unwrap().segments.try_receive(&mut segment).unwrap() {
        sequences.push(segment.header.sequence);
    }
    (sequences, ended)
}

#[test]
fn a_worker_gives_a_heartbeat_a_round_and_delivers_the_round_in_which_it_is_stopped() {
    let supervisor = FakeSupervisor::stopping_after_heartbeats(3);
    let (sequences, ended) = run(&supervisor, |plan| snapshot(plan, plan.architecture_hash));
    ended.unwrap();
    assert_eq!(supervisor.heartbeats(), [Activity::Stepping; 3]);
    assert_eq!(sequences, (1..=3 * ENVS as u64).collect::<Vec<_>>());
    let reports = supervisor.reports();
    assert!(matches!(&reports[0], Report::EnvironmentReady { spec } if spec.action_len == 1));
    let mut total = Sent::default();
    for report in &reports[1..] {
        let Report::Sent(sent) = report else { panic!("{report:?}") };
        total += *sent;
    }
    assert_eq!(total, Sent { produced: 6, sent: 6, resent: 0, acked: 0 });
    assert_eq!(supervisor.unacknowledged(), 6);
}

#[test]
fn a_worker_refuses_a_foreign_policy_with_one_warning_a_look_and_waits_for_the_next() {
    let supervisor = FakeSupervisor::stopping_after_heartbeats(1);
    let (sequences, ended) = run(&supervisor, |plan| snapshot(plan, plan.architecture_hash + 1));
    ended.unwrap();
    assert_eq!(supervisor.heartbeats(), [Activity::Attaching]);
    assert_eq!(sequences, Vec::<u64>::new());
    let warnings = supervisor.warnings();
    assert_eq!(warnings.len(), 2, "{warnings:?}");
    assert!(warnings[0].contains("worker 0 rejected a policy snapshot"), "{warnings:?}");
}

#[test]
fn a_worker_that_is_stopped_before_it_has_a_learner_reports_its_environments_and_ends() {
    let (supervisor, config) = (FakeSupervisor::default(), config());
    supervisor.stop.store(true, Ordering::Release);
    worker::run(worker(&config), &supervisor, without_learner).unwrap();
    assert!(matches!(supervisor.reports()[..], [Report::EnvironmentReady { .. }]));
}

#[test]
fn a_worker_whose_supervisor_is_gone_before_it_began_fails() {
    let (supervisor, config) = (FakeSupervisor::default(), config());
    supervisor.gone.store(true, Ordering::Release);
    let error = worker::run(worker(&config), &supervisor, without_learner).unwrap_err();
    assert!(matches!(error, WorkerError::Report(_)), "{error}");
}

#[test]
fn an_evaluator_keeps_the_row_of_each_request_and_then_reports_it() {
    let supervisor = FakeSupervisor::stopping_on(
        |report| matches!(report, Report::Evaluated(row) if row.policy_version == 2),
    );
    let config = config();
    let mut evaluator = evaluator::evaluator(interpreter(), &config, |_| ()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let policy_path = |version: u64| folder.path().join(version.to_string());
    for policy_version in [1, 2] {
        let policy = evaluator.policy();
        let snapshot = ParameterSnapshot {
            version: policy_version,
            architecture_hash: policy.architecture_hash(),
            values: vec![0.0; policy.parameters_len()],
            ..ParameterSnapshot::default()
        };
        let bytes = policy_file::encode(policy, &snapshot, None, None).unwrap();
        std::fs::write(policy_path(policy_version), bytes).unwrap();
        supervisor.command(Command::Evaluate(EvaluationRequest {
            env_steps: 10 * policy_version,
            updates: 1,
            segments: 2,
            wall_s: 1.5,
            policy_version,
        }));
    }
    let mut kept = Vec::new();
    let evaluations =
        Evaluations { config: &config, policy_path: &policy_path, stop: &supervisor.stop };
    evaluator::run(&mut evaluator, &evaluations, &supervisor, &mut |row| {
        let reported = supervisor.reports().len();
        kept.push((reported, row.clone()));
        Ok(())
    })
    .unwrap();
    let reports = supervisor.reports();
    assert_eq!(reports.len(), 3, "{reports:?}");
    for (index, (reported_before, row)) in kept.iter().enumerate() {
        assert_eq!(*reported_before, index + 1);
        assert_eq!(reports[index + 1], Report::Evaluated(row.clone()));
        assert_eq!((row.returns.len(), row.wall_s), (3, 1.5));
    }
}
