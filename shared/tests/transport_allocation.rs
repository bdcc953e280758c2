//! Counts the allocations of sending, receiving and reading snapshots after start-up.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail the test")]

mod counting_allocator;
mod transport_support;

use counting_allocator::allocations_of;
use dmprl_shared::segment::Segment;
use dmprl_shared::transport::delivery::{Acknowledgements, Inbox, LogIdentity, Outbox, SegmentLog};
use dmprl_shared::transport::shared_memory::{attach, serve};
use dmprl_shared::transport::{
    AcknowledgementPublisher, AcknowledgementSubscriber, ParameterPublisher, ParameterSubscriber,
    SegmentReceiver, SendOutcome,
};
use transport_support::{LAYOUT, Parent, header, plan, snapshot};

fn log(parent: &Parent) -> SegmentLog {
    let identity = LogIdentity { run_id: 7, architecture_hash: 1 };
    SegmentLog::open(&parent.path().join("log"), identity, LAYOUT, 1 << 30).unwrap()
}

/// The only test in its binary, because the counter counts every thread. iceoryx2 0.10 allocates
/// about 100 bytes for each sample that is written and nothing for reading; dmprl adds none.
#[test]
fn the_steady_state_allocates_only_what_iceoryx2_does_for_a_sample() {
    const ROUNDS: u64 = 1000;
    let parent = Parent::new();
    let domain = parent.domain("run");
    let plan = plan(2, 8);
    let mut learner = serve(domain.path(), &plan).unwrap();
    let mut inbox = Inbox::new(plan.worker_count);
    inbox.log_to(log(&parent));
    let mut workers = [0, 1].map(|index| {
        let outbox = Outbox::new(LAYOUT, 2 * plan.queue_segments, index, 1);
        (attach(domain.path(), &plan, index as usize).unwrap(), outbox, 0)
    });
    let mut acknowledgements = Acknowledgements { epoch: 0, marks: Vec::with_capacity(2) };
    let mut segment = Segment::zeroed(LAYOUT);
    let block = vec![0.0; LAYOUT.block_len()];
    let [mut published, mut taken] = [0, 0].map(snapshot);
    // Connects all ports.
    learner.segments.try_receive(&mut segment).unwrap();
    learner.parameters.publish(&published).unwrap();
    learner.acknowledgements.acknowledge(inbox.acknowledge().unwrap()).unwrap();
    let (mut offers, mut delivered, mut sending, mut reading) = (0, 0, 0, 0);
    for version in 1..=ROUNDS {
        published.version = version;
        sending += allocations_of(|| {
            learner.parameters.publish(&published).unwrap();
            learner.acknowledgements.acknowledge(inbox.acknowledge().unwrap()).unwrap();
        });
        for (index, (worker, outbox, sequence)) in workers.iter_mut().enumerate() {
            reading += allocations_of(|| {
                assert!(worker.parameters.newest(&mut taken).unwrap());
                assert!(worker.acknowledgements.newest(&mut acknowledgements).unwrap());
                outbox.acknowledge(&acknowledgements);
            });
            assert!(outbox.is_empty());
            taken.version = 0;
            let mut outcome = SendOutcome::Delivered;
            while outcome == SendOutcome::Delivered {
                *sequence += 1;
                let offer = || {
                    assert!(outbox.put(&header(index as u32, 1, *sequence), &block));
                    outcome = outbox.offer(&mut worker.segments).unwrap();
                };
                sending += allocations_of(offer);
                offers += 1;
            }
            assert_eq!(outcome, SendOutcome::Full);
        }
        let mut take = || {
            while learner.segments.try_receive(&mut segment).unwrap() {
                inbox.settle(&segment.header, &segment.block).unwrap();
                delivered += 1;
            }
            inbox.acknowledge().unwrap();
        };
        for (worker, outbox, _) in &mut workers {
            reading += allocations_of(&mut take);
            // The segment that did not fit into the full queue before.
            sending += allocations_of(|| {
                assert_eq!(outbox.offer(&mut worker.segments).unwrap(), SendOutcome::Delivered);
            });
            offers += 1;
        }
        reading += allocations_of(&mut take);
    }
    assert_eq!(reading, 0);
    assert!(sending <= offers + 2 * ROUNDS, "{sending} allocations for {offers} segments");
    assert_eq!(delivered, ROUNDS * 2 * (plan.queue_segments as u64 + 1));
}
