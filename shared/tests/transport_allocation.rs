//! What sending, receiving and taking snapshots allocate after start-up.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail the test")]

mod transport_support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicU64, Ordering};

use dmprl_shared::segment::Segment;
use dmprl_shared::transport::shared_memory::{attach, serve};
use dmprl_shared::transport::{
    ParameterPublisher, ParameterSubscriber, SegmentReceiver, SegmentSender, SendOutcome,
};
use transport_support::{LAYOUT, Parent, header, plan, snapshot};

struct Counting;

static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);

// SAFETY: all work is the system allocator's; the counter does not touch the memory.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// How many allocations `work` does.
fn allocations(work: impl FnOnce()) -> u64 {
    let before = ALLOCATIONS.load(Ordering::Relaxed);
    work();
    ALLOCATIONS.load(Ordering::Relaxed) - before
}

/// Alone in its binary: the counter sees every thread. iceoryx2 0.10 allocates about 100 bytes for
/// each sample that is filled, 0 for each that is read; we add nothing to that.
#[test]
fn the_steady_state_allocates_only_what_iceoryx2_does_for_a_sample() {
    const ROUNDS: u64 = 1000;
    let parent = Parent::new();
    let domain = parent.domain("run");
    let plan = plan(2, 8);
    let mut learner = serve(domain.path(), &plan).unwrap();
    let mut workers = [0, 1].map(|index| attach(domain.path(), &plan, index).unwrap());
    let mut segment = Segment::zeroed(LAYOUT);
    let block = vec![0.0; LAYOUT.block_len()];
    let mut published = snapshot(0);
    let mut taken = snapshot(0);
    // Connects everyone.
    learner.segments.try_receive(&mut segment).unwrap();
    learner.parameters.publish(&published).unwrap();
    let (mut offers, mut delivered, mut sending, mut reading) = (0, 0, 0, 0);
    for version in 1..=ROUNDS {
        published.version = version;
        sending += allocations(|| learner.parameters.publish(&published).unwrap());
        for worker in &mut workers {
            reading += allocations(|| assert!(worker.parameters.newest(&mut taken).unwrap()));
            taken.version = 0;
            let mut outcome = SendOutcome::Delivered;
            while outcome == SendOutcome::Delivered {
                let offer =
                    || outcome = worker.segments.try_send(&header(0, 1, 1), &block).unwrap();
                sending += allocations(offer);
                offers += 1;
            }
            assert_eq!(outcome, SendOutcome::Full);
        }
        reading += allocations(|| {
            while learner.segments.try_receive(&mut segment).unwrap() {
                delivered += 1;
            }
        });
    }
    assert_eq!(reading, 0);
    assert!(sending <= offers + ROUNDS, "{sending} allocations for {offers} segments");
    assert_eq!(delivered, ROUNDS * 2 * plan.queue_segments as u64);
}
