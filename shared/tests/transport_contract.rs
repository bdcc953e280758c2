//! The contract of every transport, tested in process and over shared memory.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail the test")]

mod transport_support;

use dmprl_shared::parameters::{ParameterSnapshot, SnapshotError};
use dmprl_shared::segment::Segment;
use dmprl_shared::transport::delivery::{Acknowledgements, Watermark};
use dmprl_shared::transport::shared_memory::{Domain, attach, hear, serve, subscribe};
use dmprl_shared::transport::{
    AcknowledgementPublisher, AcknowledgementSubscriber, ParameterPublisher, ParameterSubscriber,
    SegmentReceiver, SegmentSender, SendOutcome, TransportError, in_process,
};
use transport_support::{
    ARCHITECTURE, LAYOUT, PARAMETERS_LEN, Parent, assert_whole, fill, header, plan, snapshot,
};

type Subscriber = Box<dyn ParameterSubscriber + Send>;
type Listener = Box<dyn AcknowledgementSubscriber + Send>;

/// One learner and its workers, connected by either transport.
struct Transport {
    senders: Vec<Box<dyn SegmentSender + Send>>,
    receiver: Box<dyn SegmentReceiver + Send>,
    publisher: Box<dyn ParameterPublisher + Send>,
    acknowledger: Box<dyn AcknowledgementPublisher + Send>,
    join: Box<dyn Fn() -> Subscriber>,
    listen: Box<dyn Fn() -> Listener>,
    _domain: Option<(Domain, Parent)>,
}

fn over_memory_of_one_process(workers: usize, queue_segments: usize) -> Transport {
    let (senders, receiver) = in_process::segment_queues(workers, queue_segments, LAYOUT);
    let (publisher, subscriber) = in_process::parameter_channel(ARCHITECTURE);
    let (acknowledger, listener) = in_process::acknowledgement_channel(workers);
    Transport {
        senders: senders.into_iter().map(|sender| Box::new(sender) as _).collect(),
        receiver: Box::new(receiver),
        publisher: Box::new(publisher),
        acknowledger: Box::new(acknowledger),
        join: Box::new(move || Box::new(subscriber.clone())),
        listen: Box::new(move || Box::new(listener.clone())),
        _domain: None,
    }
}

fn over_shared_memory(workers: usize, queue_segments: usize) -> Transport {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let path = domain.path().to_owned();
    let plan = plan(workers, queue_segments);
    let learner = serve(&path, &plan).unwrap();
    let worker = |index| Box::new(attach(&path, &plan, index).unwrap().segments) as _;
    let mut transport = Transport {
        senders: (0..workers).map(worker).collect(),
        receiver: Box::new(learner.segments),
        publisher: Box::new(learner.parameters),
        acknowledger: Box::new(learner.acknowledgements),
        join: {
            let (path, plan) = (path.clone(), plan.clone());
            Box::new(move || Box::new(subscribe(&path, &plan).unwrap()))
        },
        listen: Box::new(move || Box::new(hear(&path, &plan).unwrap())),
        _domain: Some((domain, parent)),
    };
    // The learner's first poll connects the queues. Until then a full queue returns `Detached`.
    assert!(!transport.receiver.try_receive(&mut Segment::default()).unwrap());
    transport
}

fn offer(transport: &mut Transport, worker: usize, sequence: u64) -> SendOutcome {
    let mut block = vec![0.0; LAYOUT.block_len()];
    fill(&mut block, sequence);
    assert!(!transport.senders[worker].renew().unwrap());
    transport.senders[worker].try_send(&header(worker as u32, 1, sequence), &block).unwrap()
}

fn slow_reader_loses_and_duplicates_no_segment(mut transport: Transport) {
    const SEGMENTS: u64 = 100_000;
    const PAUSE_EVERY: u64 = 1000;
    let (full, seen_full) = std::sync::mpsc::channel();
    let mut sender = transport.senders.pop().unwrap();
    let worker = std::thread::spawn(move || {
        let mut block = vec![0.0; LAYOUT.block_len()];
        for sequence in 1..=SEGMENTS {
            fill(&mut block, sequence);
            while sender.try_send(&header(0, 1, sequence), &block).unwrap()
                != SendOutcome::Delivered
            {
                let _ = full.send(());
                std::thread::yield_now();
            }
        }
    });
    let mut segment = Segment::zeroed(LAYOUT);
    for sequence in 1..=SEGMENTS {
        if sequence % PAUSE_EVERY == 0 && sequence < SEGMENTS - PAUSE_EVERY {
            // The reader pauses until the queue is full.
            while seen_full.try_recv().is_ok() {}
            seen_full.recv().unwrap();
        }
        while !transport.receiver.try_receive(&mut segment).unwrap() {
            std::thread::yield_now();
        }
        assert_eq!(segment.header, header(0, 1, sequence));
        assert_whole(&segment);
    }
    worker.join().unwrap();
    assert!(!transport.receiver.try_receive(&mut segment).unwrap());
}

fn a_full_queue_says_so_and_keeps_what_it_has(mut transport: Transport) {
    for sequence in 1..=4 {
        assert_eq!(offer(&mut transport, 0, sequence), SendOutcome::Delivered);
    }
    for _ in 0..3 {
        assert_eq!(offer(&mut transport, 0, 5), SendOutcome::Full);
    }
    let mut segment = Segment::default();
    for sequence in 1..=4 {
        assert!(transport.receiver.try_receive(&mut segment).unwrap());
        assert_eq!(segment.header.sequence, sequence);
        assert_whole(&segment);
    }
    assert!(!transport.receiver.try_receive(&mut segment).unwrap());
    assert_eq!(offer(&mut transport, 0, 5), SendOutcome::Delivered);
}

fn full_queues_are_drained_in_turn(mut transport: Transport) {
    let mut taken = [0_u32; 4];
    let mut sequences = [0; 4];
    let mut segment = Segment::default();
    for _ in 0..4000 {
        for (worker, sequence) in sequences.iter_mut().enumerate() {
            while offer(&mut transport, worker, *sequence + 1) == SendOutcome::Delivered {
                *sequence += 1;
            }
        }
        assert!(transport.receiver.try_receive(&mut segment).unwrap());
        taken[segment.header.worker_id as usize] += 1;
    }
    let (max, min) = (taken.iter().max().unwrap(), taken.iter().min().unwrap());
    assert!(f64::from(*max) <= 1.5 * f64::from(*min), "{taken:?}");
}

fn sending_without_a_learner_returns_detached(mut transport: Transport) {
    assert_eq!(offer(&mut transport, 0, 1), SendOutcome::Delivered);
    transport.receiver = over_memory_of_one_process(1, 1).receiver;
    for _ in 0..10 {
        assert_eq!(offer(&mut transport, 0, 2), SendOutcome::Detached);
    }
}

fn segment_of_the_wrong_length_is_rejected(mut transport: Transport) {
    let short = vec![0.0; LAYOUT.block_len() - 1];
    let error = transport.senders[0].try_send(&header(0, 1, 1), &short).unwrap_err();
    let TransportError::Length { expected, got } = error else { panic!("{error}") };
    assert_eq!((expected, got), (LAYOUT.block_len(), short.len()));
    assert!(!transport.receiver.try_receive(&mut Segment::default()).unwrap());
}

fn newest_snapshot_replaces_earlier_ones(mut transport: Transport) {
    let mut subscriber = (transport.join)();
    let mut taken = ParameterSnapshot::default();
    assert!(!subscriber.newest(&mut taken).unwrap());
    for version in 1..=5 {
        transport.publisher.publish(&snapshot(version)).unwrap();
    }
    assert!(subscriber.newest(&mut taken).unwrap());
    assert_eq!(taken, snapshot(5));
    assert!(!subscriber.newest(&mut taken).unwrap());
}

fn snapshots_are_complete_and_versions_never_decrease(mut transport: Transport) {
    const VERSIONS: u64 = 2000;
    let mut subscriber = (transport.join)();
    let reader = std::thread::spawn(move || {
        let mut taken = ParameterSnapshot::default();
        while taken.version < VERSIONS {
            let before = taken.version;
            if subscriber.newest(&mut taken).unwrap() {
                assert!(taken.version > before);
                assert_eq!(taken, snapshot(taken.version));
            }
        }
    });
    for version in 1..=VERSIONS {
        transport.publisher.publish(&snapshot(version)).unwrap();
    }
    while !reader.is_finished() {
        transport.publisher.maintain().unwrap();
    }
    reader.join().unwrap();
}

fn late_subscriber_gets_the_newest_snapshot(mut transport: Transport) {
    transport.publisher.publish(&snapshot(1)).unwrap();
    transport.publisher.publish(&snapshot(2)).unwrap();
    let mut subscriber = (transport.join)();
    transport.publisher.maintain().unwrap();
    let mut taken = ParameterSnapshot::default();
    assert!(subscriber.newest(&mut taken).unwrap());
    assert_eq!(taken, snapshot(2));
}

fn snapshot_of_another_architecture_is_rejected(mut transport: Transport) {
    let mut subscriber = (transport.join)();
    transport.publisher.publish(&snapshot(1)).unwrap();
    let mut taken = ParameterSnapshot::default();
    assert!(subscriber.newest(&mut taken).unwrap());
    let foreign = ParameterSnapshot { architecture_hash: 1, ..snapshot(2) };
    transport.publisher.publish(&foreign).unwrap();
    let error = subscriber.newest(&mut taken).unwrap_err();
    let expected = SnapshotError::Architecture { version: 2, expected: ARCHITECTURE, got: 1 };
    assert!(matches!(&error, TransportError::Snapshot(e) if *e == expected), "{error}");
    assert_eq!(taken, snapshot(1));
    transport.publisher.publish(&snapshot(3)).unwrap();
    assert!(subscriber.newest(&mut taken).unwrap());
    assert_eq!(taken.values.len(), PARAMETERS_LEN);
}

fn newest_acknowledgements_replace_earlier_ones(mut transport: Transport) {
    let marks = |sequence| [1, 2].map(|incarnation| Watermark { incarnation, sequence });
    let mut listener = (transport.listen)();
    let mut taken = Acknowledgements::default();
    assert!(!listener.newest(&mut taken).unwrap());
    for sequence in 1..=5 {
        transport.acknowledger.acknowledge(&marks(sequence)).unwrap();
    }
    assert!(listener.newest(&mut taken).unwrap());
    assert_eq!((taken.epoch, &taken.marks[..]), (1, &marks(5)[..]));
    assert!(!listener.newest(&mut taken).unwrap());
    let error = transport.acknowledger.acknowledge(&marks(6)[..1]).unwrap_err();
    assert!(matches!(error, TransportError::Length { .. }), "{error}");
    assert!(!listener.newest(&mut taken).unwrap());
}

macro_rules! contract {
    ($($promise:ident($workers:expr, $queue_segments:expr);)*) => {
        mod in_one_process {
            $(#[test] fn $promise() {
                super::$promise(super::over_memory_of_one_process($workers, $queue_segments));
            })*
        }
        mod shared_memory {
            $(#[test] fn $promise() {
                super::$promise(super::over_shared_memory($workers, $queue_segments));
            })*
        }
    };
}

contract! {
    slow_reader_loses_and_duplicates_no_segment(1, 64);
    a_full_queue_says_so_and_keeps_what_it_has(1, 4);
    full_queues_are_drained_in_turn(4, 16);
    sending_without_a_learner_returns_detached(1, 8);
    segment_of_the_wrong_length_is_rejected(1, 4);
    newest_snapshot_replaces_earlier_ones(1, 1);
    snapshots_are_complete_and_versions_never_decrease(1, 1);
    late_subscriber_gets_the_newest_snapshot(1, 1);
    snapshot_of_another_architecture_is_rejected(1, 1);
    newest_acknowledgements_replace_earlier_ones(2, 1);
}
