//! Tests of shared memory with processes that are killed at arbitrary times.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail the test")]

mod transport_support;

use std::path::Path;
use std::time::Duration;

use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::segment::Segment;
use dmprl_shared::transport::shared_memory::{LearnerEnd, WorkerEnd, attach, serve};
use dmprl_shared::transport::{
    ParameterPublisher, ParameterSubscriber, SegmentReceiver, SegmentSender, SendOutcome,
};
use rustix::process::Signal;
use transport_support::{
    LAYOUT, Parent, Process, assert_whole, eventually, fill, header, plan, role, snapshot,
};

const ENTRY: &str = "another_process_plays_its_role";
const QUEUE_SEGMENTS: usize = 32;
const WORKERS: usize = 2;

#[test]
fn another_process_plays_its_role() {
    let Some((role, domain, incarnation)) = role() else { return };
    match role.as_str() {
        "worker" => play_worker(&domain, 0, incarnation),
        "other worker" => play_worker(&domain, 1, incarnation),
        "learner" => play_learner(&domain, incarnation),
        "worker that dies in a loan" => die_in_a_loan(&domain, incarnation),
        other => panic!("role {other}"),
    }
}

/// Retries to attach until it succeeds, then sends forever.
fn play_worker(domain: &Path, index: usize, incarnation: u32) {
    let plan = plan(WORKERS, QUEUE_SEGMENTS);
    let mut worker = eventually("the worker attaches", || attach(domain, &plan, index).ok());
    let mut block = vec![0.0; LAYOUT.block_len()];
    for sequence in 1.. {
        fill(&mut block, sequence);
        let header = header(index as u32, incarnation, sequence);
        loop {
            worker.segments.renew().unwrap();
            match worker.segments.try_send(&header, &block).unwrap() {
                SendOutcome::Delivered => break,
                _ => std::thread::sleep(Duration::from_micros(50)),
            }
        }
    }
}

/// Number of segments sent before the fatal one.
const BEFORE_THE_LOAN: u64 = 3;

/// Sends a block whose second half is mapped beyond the end of its file. The kernel kills the
/// process in the middle of copying the block into the loaned sample.
fn die_in_a_loan(domain: &Path, incarnation: u32) {
    /// A multiple of every page size.
    const FILE_BYTES: usize = 64 << 10;
    let none = rustix::process::Rlimit { current: Some(0), maximum: Some(0) };
    rustix::process::setrlimit(rustix::process::Resource::Core, none).unwrap();
    let plan = plan(WORKERS, QUEUE_SEGMENTS);
    let mut worker = eventually("the worker attaches", || attach(domain, &plan, 0).ok());
    let mut block = vec![0.0; LAYOUT.block_len()];
    for sequence in 1..=BEFORE_THE_LOAN {
        fill(&mut block, sequence);
        let header = header(0, incarnation, sequence);
        eventually("a segment is sent", || {
            let sent = worker.segments.try_send(&header, &block).unwrap();
            (sent == SendOutcome::Delivered).then_some(())
        });
    }
    let file = tempfile::tempfile().unwrap();
    file.set_len(FILE_BYTES as u64).unwrap();
    // SAFETY: no other process uses the file. Reading beyond its end kills this process on purpose.
    let map = unsafe { memmap2::MmapOptions::new().len(2 * FILE_BYTES).map(&file) }.unwrap();
    let values: &[f32] = bytemuck::cast_slice(&map);
    let from = FILE_BYTES / size_of::<f32>() - LAYOUT.block_len() / 2;
    let torn = &values[from..from + LAYOUT.block_len()];
    let outcome = worker.segments.try_send(&header(0, incarnation, BEFORE_THE_LOAN + 1), torn);
    panic!("reading beyond the end of the file did not kill the process: {outcome:?}");
}

/// Serves the domain, publishes a snapshot whose version is its incarnation, and receives forever.
fn play_learner(domain: &Path, incarnation: u32) {
    let plan = plan(WORKERS, QUEUE_SEGMENTS);
    let mut learner = eventually("the learner serves", || serve(domain, &plan).ok());
    learner.parameters.publish(&snapshot(u64::from(incarnation))).unwrap();
    let mut segment = Segment::zeroed(LAYOUT);
    for round in 0_u64.. {
        if !learner.segments.try_receive(&mut segment).unwrap() {
            std::thread::sleep(Duration::from_micros(50));
        }
        if round % 1000 == 0 {
            learner.segments.maintain().unwrap();
            learner.parameters.maintain().unwrap();
        }
    }
}

/// Receives one segment, if there is one, and checks that its worker's sequence has no gap. Returns
/// whether it received one.
fn take(learner: &mut LearnerEnd, last: &mut [(u32, u64); WORKERS]) -> bool {
    let mut segment = Segment::zeroed(LAYOUT);
    if !learner.segments.try_receive(&mut segment).unwrap() {
        return false;
    }
    assert_whole(&segment);
    let last = &mut last[segment.header.worker_id as usize];
    let (incarnation, sequence) = (segment.header.incarnation, segment.header.sequence);
    let expected = if incarnation == last.0 { last.1 + 1 } else { 1 };
    assert!(incarnation >= last.0, "incarnation {incarnation} after {}", last.0);
    assert_eq!(sequence, expected, "of incarnation {incarnation}");
    *last = (incarnation, sequence);
    true
}

#[test]
fn a_killed_worker_loses_nothing_delivered_and_its_successor_continues() {
    const ROUNDS: u32 = 12;
    let parent = Parent::new();
    let domain = parent.domain("run");
    let mut learner = serve(domain.path(), &plan(WORKERS, QUEUE_SEGMENTS)).unwrap();
    let mut last = [(0, 0); WORKERS];
    for incarnation in 1..=ROUNDS {
        let mut worker = Process::start(ENTRY, "worker", domain.path(), incarnation);
        let enough = u64::from(incarnation) * 100;
        eventually("segments of this incarnation arrive", || {
            learner.segments.maintain().unwrap();
            while last[0] != (incarnation, enough) && take(&mut learner, &mut last) {}
            (last[0] == (incarnation, enough)).then_some(())
        });
        worker.assert_alive();
        worker.kill();
    }
    let before = last;
    while take(&mut learner, &mut last) {}
    assert!(last[0].1 - before[0].1 <= QUEUE_SEGMENTS as u64);
    learner.segments.maintain().unwrap();
}

/// There are more deaths than slots in the queue, so loans that are not returned would fill it.
#[test]
fn a_worker_that_dies_with_a_loaned_sample_takes_no_place_with_it() {
    const DEATHS: u32 = QUEUE_SEGMENTS as u32 + 8;
    let parent = Parent::new();
    let domain = parent.domain("run");
    let mut learner = serve(domain.path(), &plan(WORKERS, QUEUE_SEGMENTS)).unwrap();
    let mut last = [(0, 0); WORKERS];
    for death in 1..=DEATHS {
        let mut worker = Process::start(ENTRY, "worker that dies in a loan", domain.path(), death);
        assert_eq!(
            worker.died_of(|| learner.segments.maintain().unwrap()),
            Some(Signal::BUS.as_raw())
        );
        while take(&mut learner, &mut last) {}
        assert_eq!(last[0], (death, BEFORE_THE_LOAN), "no segment is incomplete or lost");
    }
    let _worker = Process::start(ENTRY, "worker", domain.path(), DEATHS + 1);
    eventually("a whole worker's segments arrive", || {
        learner.segments.maintain().unwrap();
        while last[0].1 < 1000 && take(&mut learner, &mut last) {}
        (last[0].0 == DEATHS + 1 && last[0].1 >= 1000).then_some(())
    });
}

#[test]
fn workers_killed_while_they_start_block_nobody() {
    const KILLS: u32 = 40;
    let parent = Parent::new();
    let domain = parent.domain("run");
    let mut learner = serve(domain.path(), &plan(WORKERS, QUEUE_SEGMENTS)).unwrap();
    let mut last = [(0, 0); WORKERS];
    for kill in 1..=KILLS {
        let mut worker = Process::start(ENTRY, "worker", domain.path(), kill);
        // The delay varies the time of the fault. The test passes for any delay.
        std::thread::sleep(Duration::from_micros(u64::from(kill) * 500));
        worker.kill();
        learner.segments.maintain().unwrap();
        while take(&mut learner, &mut last) {}
    }
    let _worker = Process::start(ENTRY, "worker", domain.path(), KILLS + 1);
    eventually("a whole worker's segments arrive", || {
        learner.segments.maintain().unwrap();
        while last[0].1 < 1000 && take(&mut learner, &mut last) {}
        (last[0].0 == KILLS + 1 && last[0].1 >= 1000).then_some(())
    });
}

/// Starts and kills other workers continuously, which must not affect the first one.
#[test]
fn a_worker_is_not_disturbed_by_the_deaths_of_others() {
    const KILLS: u32 = 60;
    let parent = Parent::new();
    let domain = parent.domain("run");
    let mut learner = serve(domain.path(), &plan(WORKERS, QUEUE_SEGMENTS)).unwrap();
    let mut steady = Process::start(ENTRY, "worker", domain.path(), 1);
    let mut last = [(0, 0); WORKERS];
    for kill in 1..=KILLS {
        let mut other = Process::start(ENTRY, "other worker", domain.path(), kill);
        let enough = last[0].1 + 50 * u64::from(kill % 5);
        eventually("the steady worker's segments arrive", || {
            learner.segments.maintain().unwrap();
            while last[0].1 < enough.max(1) && take(&mut learner, &mut last) {}
            (last[0].1 >= enough.max(1)).then_some(())
        });
        other.kill();
    }
    steady.assert_alive();
}

fn offer(worker: &mut WorkerEnd, sequence: &mut u64) -> SendOutcome {
    let mut block = vec![0.0; LAYOUT.block_len()];
    fill(&mut block, *sequence + 1);
    worker.segments.renew().unwrap();
    let outcome = worker.segments.try_send(&header(0, 1, *sequence + 1), &block).unwrap();
    if outcome == SendOutcome::Delivered {
        *sequence += 1;
    }
    outcome
}

#[test]
fn a_killed_learner_stops_no_worker_and_its_successor_takes_over() {
    const ROUNDS: u32 = 5;
    let parent = Parent::new();
    let domain = parent.domain("run");
    let plan = plan(WORKERS, QUEUE_SEGMENTS);
    let mut learner = Process::start(ENTRY, "learner", domain.path(), 1);
    let mut worker = eventually("the worker attaches", || attach(domain.path(), &plan, 0).ok());
    let mut taken = ParameterSnapshot::default();
    let mut sequence = 0;
    for incarnation in 1..=ROUNDS {
        let enough = sequence + 10 * QUEUE_SEGMENTS as u64;
        eventually("a live learner takes segments", || {
            while sequence < enough && offer(&mut worker, &mut sequence) == SendOutcome::Delivered {
            }
            (sequence == enough).then_some(())
        });
        eventually("its snapshot arrives", || {
            worker.parameters.newest(&mut taken).unwrap();
            (taken == snapshot(u64::from(incarnation))).then_some(())
        });
        learner.assert_alive();
        learner.kill();
        // Without a learner, at most a queue's capacity is accepted, and every call returns.
        let accepted = (0..1000)
            .filter(|_| offer(&mut worker, &mut sequence) == SendOutcome::Delivered)
            .count();
        assert!(accepted <= QUEUE_SEGMENTS, "{accepted}");
        learner = Process::start(ENTRY, "learner", domain.path(), incarnation + 1);
    }
}

/// In iceoryx2 0.10, opening a service hangs forever if its creator was killed while creating it.
#[test]
fn learners_killed_while_they_start_do_not_block_their_successors() {
    const KILLS: u32 = 60;
    let parent = Parent::new();
    let domain = parent.domain("run");
    for kill in 1..=KILLS {
        let mut learner = Process::start(ENTRY, "learner", domain.path(), kill);
        std::thread::sleep(Duration::from_micros(u64::from(kill) * 250));
        learner.kill();
    }
    let plan = plan(WORKERS, QUEUE_SEGMENTS);
    let mut learner = serve(domain.path(), &plan).unwrap();
    let mut worker = attach(domain.path(), &plan, 0).unwrap();
    assert_eq!(offer(&mut worker, &mut 0), SendOutcome::Delivered);
    assert!(take(&mut learner, &mut [(1, 0); WORKERS]));
}

/// Like the previous test, but with an attached worker, which must survive.
#[test]
fn learners_killed_while_they_take_over_leave_nothing_that_hangs() {
    const KILLS: u32 = 40;
    let parent = Parent::new();
    let domain = parent.domain("run");
    let plan = plan(WORKERS, QUEUE_SEGMENTS);
    let first = serve(domain.path(), &plan).unwrap();
    let mut worker = attach(domain.path(), &plan, 0).unwrap();
    drop(first);
    for kill in 1..=KILLS {
        let mut learner = Process::start(ENTRY, "learner", domain.path(), kill);
        std::thread::sleep(Duration::from_micros(u64::from(kill) * 250));
        learner.kill();
    }
    let mut learner = serve(domain.path(), &plan).unwrap();
    let mut sequence = 0;
    eventually("the worker reaches the last learner", || {
        offer(&mut worker, &mut sequence);
        let mut segment = Segment::zeroed(LAYOUT);
        learner.segments.try_receive(&mut segment).unwrap().then_some(())
    });
}
