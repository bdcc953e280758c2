//! Relay and gateway over shared memory and Zenoh on loopback, while learner, gateway and relay are
//! replaced repeatedly: every segment arrives once and in order.
#![cfg(feature = "zenoh")]
#![allow(clippy::unwrap_used)] // a helper that panics fails its test

mod attacks;

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use dmprl_bridge::gateway::{Gateway, GatewaySettings, RunFacts};
use dmprl_bridge::host_messages::Lease;
use dmprl_bridge::join::JoinSettings;
use dmprl_bridge::relay::{HostCounts, Relay, RelaySettings};
use dmprl_bridge::wire::RunState;
use dmprl_shared::config::task_defaults;
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::segment::{
    LAYOUT_VERSION, Segment, SegmentHeader, SegmentLayout, block_checksum,
};
use dmprl_shared::transport::delivery::{Acknowledgements, Inbox, Outbox};
use dmprl_shared::transport::shared_memory::{Domain, LearnerEnd, Plan, attach, serve};
use dmprl_shared::transport::{
    AcknowledgementPublisher, AcknowledgementSubscriber, ParameterPublisher, ParameterSubscriber,
    SegmentReceiver,
};

const PATIENCE: Duration = Duration::from_secs(120);
/// Interval between two checks of a condition.
const POLL: Duration = Duration::from_millis(1);
const WORKERS: usize = 3;
const SEGMENTS: u64 = 20_000;
/// Index of the first worker of another host.
const FIRST: usize = 1;
const ARCHITECTURE: u64 = 9;
const LAYOUT: SegmentLayout =
    SegmentLayout { segment_steps: 5, observation_len: 20, action_len: 4 };
/// Maximum number of retained segments of each worker.
const KEPT: usize = 512;

/// An unused endpoint on loopback.
fn endpoint(protocol: &str) -> String {
    let free = TcpListener::bind("127.0.0.1:0").unwrap();
    format!("{protocol}/{}", free.local_addr().unwrap())
}

fn facts() -> RunFacts {
    RunFacts {
        run_id: "0000000000000007".into(),
        config: String::new(),
        spec: task_defaults("reacher").unwrap().spec(),
        token: "a secret of some length".into(),
    }
}

fn join_settings(endpoint: &str, workers: usize) -> JoinSettings {
    let (endpoint, token) = (endpoint.to_owned(), facts().token);
    JoinSettings { endpoint, token, host: 1, name: "b".into(), workers: workers as u32 }
}

/// State shared by all threads.
struct Stage {
    layout: SegmentLayout,
    /// Number of workers of the other host, and of segments that each of them sends.
    workers: usize,
    segments: u64,
    over: AtomicBool,
    settled: AtomicU64,
    gaps: AtomicU64,
    refused: AtomicU64,
    /// Number of replacements so far.
    replaced: AtomicU64,
    /// Requested number of replacements of learner, gateway and relay; it grows during the test.
    replacements: [AtomicU64; 3],
}

impl Stage {
    fn new(layout: SegmentLayout, workers: usize, segments: u64) -> Arc<Self> {
        Arc::new(Self {
            layout,
            workers,
            segments,
            over: AtomicBool::default(),
            settled: AtomicU64::default(),
            gaps: AtomicU64::default(),
            refused: AtomicU64::default(),
            replaced: AtomicU64::default(),
            replacements: Default::default(),
        })
    }

    fn plan(&self, worker_count: usize) -> Plan {
        Plan {
            run_id: 7,
            architecture_hash: ARCHITECTURE,
            layout: self.layout,
            worker_count,
            queue_segments: 8,
            parameters_len: 1_000,
        }
    }

    /// The learner's plan.
    fn whole_plan(&self) -> Plan {
        self.plan(FIRST + self.workers)
    }

    fn is_over(&self) -> bool {
        self.over.load(Ordering::Acquire)
    }

    /// Returns true if the end that was started `times` times must be replaced now.
    fn is_replaced(&self, end: usize, times: u64) -> bool {
        self.replacements[end].load(Ordering::Acquire) >= times
    }

    fn until(&self, what: &str, condition: impl Fn() -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !condition() {
            assert!(Instant::now() < deadline, "not within {PATIENCE:?}: {what}");
            thread::sleep(POLL);
        }
    }
}

/// A learner that keeps its inbox when it is replaced, like one with a segment log.
fn learner(stage: &Stage, domain: PathBuf) {
    let mut inbox = Inbox::new(FIRST + stage.workers);
    let mut version = 0;
    for times in 1.. {
        let LearnerEnd { mut segments, mut parameters, mut acknowledgements } =
            serve(&domain, &stage.whole_plan()).unwrap();
        let mut segment = Segment::zeroed(stage.layout);
        let mut looked = Instant::now() - PATIENCE;
        while !stage.is_over() && !stage.is_replaced(0, times) {
            if !segments.try_receive(&mut segment).unwrap() {
                thread::sleep(Duration::from_micros(100));
            } else {
                assert_eq!(block_checksum(&segment.block), segment.header.checksum);
                assert_eq!(segment.block[0], segment.header.sequence as f32);
                match inbox.settle(&segment.header, &segment.block) {
                    Ok(gap) => {
                        stage.gaps.fetch_add(gap, Ordering::AcqRel);
                        stage.settled.fetch_add(1, Ordering::AcqRel);
                    }
                    Err(_) => drop(stage.refused.fetch_add(1, Ordering::AcqRel)),
                }
            }
            if looked.elapsed() >= Duration::from_millis(5) {
                looked = Instant::now();
                version += 1;
                let values = vec![version as f32; 1_000];
                let architecture_hash = ARCHITECTURE;
                let snapshot = ParameterSnapshot {
                    version,
                    env_steps: 1,
                    architecture_hash,
                    settled: false,
                    values,
                };
                parameters.publish(&snapshot).unwrap();
                acknowledgements.acknowledge(inbox.acknowledge().unwrap()).unwrap();
                segments.maintain().unwrap();
                parameters.maintain().unwrap();
                acknowledgements.maintain().unwrap();
            }
        }
        if stage.is_over() {
            return;
        }
        stage.replaced.fetch_add(1, Ordering::AcqRel);
    }
}

/// Opens a gateway, again and again while the learner is being replaced.
fn open_gateway(stage: &Stage, domain: &Path, endpoints: &[String]) -> Gateway {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let settings = GatewaySettings {
            endpoints,
            zenoh_file: None,
            domain,
            plan: stage.whole_plan(),
            first_worker: FIRST,
            session: 0,
            segments_max: KEPT,
        };
        match Gateway::open(settings, facts()) {
            Ok(gateway) => return gateway,
            Err(error) => assert!(Instant::now() < deadline, "{error:#}"),
        }
        thread::sleep(Duration::from_millis(5));
    }
}

fn gateway(stage: &Stage, domain: PathBuf, endpoint: String) {
    for times in 1.. {
        let endpoints = [endpoint.clone()];
        let mut gateway = open_gateway(stage, &domain, &endpoints);
        while !stage.is_over() && !stage.is_replaced(1, times) {
            if !gateway.turn().unwrap() {
                thread::sleep(Duration::from_micros(200));
            }
        }
        if stage.is_over() {
            gateway.send_acks(RunState::Complete).unwrap();
            return;
        }
        stage.replaced.fetch_add(1, Ordering::AcqRel);
    }
}

fn relay(stage: &Stage, domain: PathBuf, endpoint: String) {
    for times in 1.. {
        let settings = RelaySettings {
            join: join_settings(&endpoint, stage.workers),
            lease: Lease { first: FIRST as u32, session: 0 },
            zenoh_file: None,
            domain: &domain,
            plan: &stage.plan(stage.workers),
            segments_max: KEPT,
            in_flight_bytes_max: 1 << 20,
        };
        let mut relay = Relay::start(settings).unwrap();
        while !stage.is_over() && !stage.is_replaced(2, times) {
            relay.turn(&HostCounts::default()).unwrap();
            thread::sleep(Duration::from_micros(100));
        }
        assert_eq!(relay.damaged(), 0);
        if stage.is_over() {
            return;
        }
        stage.replaced.fetch_add(1, Ordering::AcqRel);
    }
}

/// A worker that sends as fast as possible until the learner has acknowledged all segments. Returns
/// the version of its newest policy.
fn worker(stage: &Stage, index: u32, domain: PathBuf) -> u64 {
    let deadline = Instant::now() + PATIENCE;
    let mut end = loop {
        match attach(&domain, &stage.plan(stage.workers), index as usize) {
            Ok(end) => break end,
            Err(error) => assert!(Instant::now() < deadline, "{error}"),
        }
        thread::sleep(Duration::from_millis(2));
    };
    let mut outbox = Outbox::new(stage.layout, KEPT, index, 0);
    let (mut heard, mut snapshot) = (Acknowledgements::default(), ParameterSnapshot::default());
    let mut sequence = 0;
    let mut block = vec![0.0; stage.layout.block_len()];
    while sequence < stage.segments || !outbox.is_empty() {
        assert!(Instant::now() < deadline, "worker {index} at {sequence}, kept {}", outbox.len());
        if sequence < stage.segments && outbox.len() < outbox.capacity() {
            sequence += 1;
            block[0] = sequence as f32;
            let header = SegmentHeader {
                layout_version: LAYOUT_VERSION,
                sequence,
                worker_id: index,
                checksum: block_checksum(&block),
                ..SegmentHeader::default()
            };
            assert!(outbox.put(&header, &block));
        } else {
            thread::sleep(Duration::from_micros(200));
        }
        outbox.offer(&mut end.segments).unwrap();
        if end.acknowledgements.newest(&mut heard).unwrap() {
            outbox.acknowledge(&heard);
        }
        end.parameters.newest(&mut snapshot).unwrap();
    }
    snapshot.version
}

/// Threads of learner, gateway and relay.
type Replaced = [thread::JoinHandle<()>; 3];

fn start(stage: &Arc<Stage>, domains: &[Domain; 2]) -> (Replaced, Vec<thread::JoinHandle<u64>>) {
    let [here, there] = domains.each_ref().map(|domain| domain.path().to_owned());
    let endpoint = endpoint("tls");
    let spawn = |work: fn(&Stage, PathBuf, String), domain: &PathBuf| {
        let (stage, domain, endpoint) = (Arc::clone(stage), domain.clone(), endpoint.clone());
        thread::spawn(move || work(&stage, domain, endpoint))
    };
    let ends = [
        spawn(|stage, domain, _| learner(stage, domain), &here),
        spawn(gateway, &here),
        spawn(relay, &there),
    ];
    let workers = (0..stage.workers as u32).map(|index| {
        let (stage, there) = (Arc::clone(stage), there.clone());
        thread::spawn(move || worker(&stage, index, there))
    });
    (ends, workers.collect())
}

fn two_domains(folder: &std::path::Path) -> [Domain; 2] {
    ["a", "b"].map(|name| Domain::create(&folder.join("p"), name).unwrap())
}

/// Regression test: a segment longer than the initial window was once never sent.
#[test]
fn segments_of_any_length_arrive() {
    let layout = SegmentLayout { segment_steps: 5, observation_len: 5_000, action_len: 4 };
    assert!(layout.block_len() * size_of::<f32>() > 65_536);
    let folder = tempfile::tempdir().unwrap();
    let domains = two_domains(folder.path());
    let stage = Stage::new(layout, 1, 100);
    let (ends, workers) = start(&stage, &domains);
    for worker in workers {
        worker.join().unwrap();
    }
    stage.over.store(true, Ordering::Release);
    ends.into_iter().for_each(|end| end.join().unwrap());
    assert_eq!(stage.settled.load(Ordering::Acquire), 100);
}

#[test]
fn segments_arrive_once_and_in_order_while_processes_are_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let domains = two_domains(folder.path());
    let stage = Stage::new(LAYOUT, WORKERS, SEGMENTS);
    let (ends, workers) = start(&stage, &domains);
    let total = WORKERS as u64 * SEGMENTS;
    for (round, end) in [2, 1, 0, 1, 0, 2].into_iter().enumerate() {
        let some = total * (round as u64 + 1) / 8;
        stage.until("segments", || {
            ends.iter().any(thread::JoinHandle::is_finished)
                || stage.settled.load(Ordering::Acquire) >= some
        });
        stage.replacements[end].fetch_add(1, Ordering::AcqRel);
        stage.until("a replacement", || {
            ends.iter().any(thread::JoinHandle::is_finished)
                || stage.replaced.load(Ordering::Acquire) > round as u64
        });
    }
    let versions: Vec<u64> = workers.into_iter().map(|worker| worker.join().unwrap()).collect();
    stage.over.store(true, Ordering::Release);
    ends.into_iter().for_each(|end| end.join().unwrap());
    assert_eq!(stage.settled.load(Ordering::Acquire), total);
    assert_eq!(stage.gaps.load(Ordering::Acquire), 0);
    assert!(versions.iter().all(|version| *version > 10), "{versions:?}");
}
