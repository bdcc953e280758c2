//! Jobs of a thread pool in every order of its threads, up to a number of preemptions.

use dmprl_loom::thread_pool::ThreadPool;
use loom::cell::UnsafeCell;
use loom::model::Builder;
use loom::sync::atomic::{AtomicUsize, Ordering};

/// Preemptions in one order. Loom's authors found that two or three reveal most errors.
const PREEMPTIONS_MAX: usize = 3;

fn in_every_order(run: impl Fn() + Sync + Send + 'static) {
    let mut builder = Builder::new();
    builder.preemption_bound = Some(PREEMPTIONS_MAX);
    builder.check(run);
}

#[test]
fn every_part_of_consecutive_jobs_is_done_once_before_the_job_returns() {
    in_every_order(|| {
        let mut pool = ThreadPool::new(2);
        for _ in 0..2 {
            let counts = [AtomicUsize::new(0), AtomicUsize::new(0)];
            pool.run(counts.len(), &|part| {
                counts[part].fetch_add(1, Ordering::Relaxed);
            });
            assert!(counts.iter().all(|count| count.load(Ordering::Relaxed) == 1));
        }
    });
}

#[test]
fn what_a_part_writes_is_visible_when_its_job_returns() {
    in_every_order(|| {
        let mut pool = ThreadPool::new(2);
        let mut cells = [UnsafeCell::new(0), UnsafeCell::new(0)];
        // SAFETY: loom reports accesses of which neither happens before the other.
        pool.for_each(&mut cells, |cell| cell.with_mut(|value| unsafe { *value += 1 }));
        for cell in &cells {
            // SAFETY: as above.
            assert_eq!(cell.with(|value| unsafe { *value }), 1);
        }
    });
}

/// The pool once announced its end without the lock. A thread between its check for a job and its
/// wait then missed the announcement, and the process never ended.
#[test]
fn a_pool_that_is_dropped_ends_its_threads() {
    in_every_order(|| drop(ThreadPool::new(3)));
}
