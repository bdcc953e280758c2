//! The threads of an update: they share out its parts, one part to one thread.
//!
//! Which thread does which part is left to chance, what a part computes is not, and parts share no
//! result: so the number of threads changes no bit.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};

/// Looks at the counter before a thread goes to sleep: about as long as an update's pauses last.
const SPINS: u32 = 2_000;

/// A closure that a crew runs for every part, borrowed for the time of one call.
type Work = *const (dyn Fn(usize) + Sync);

/// Threads that wait for work.
#[derive(Debug)]
pub struct Crew {
    shared: Arc<Shared>,
    helpers: Vec<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    /// Counts the jobs; a helper works on each number once.
    number: AtomicU32,
    job: Mutex<Job>,
    begun: Condvar,
    next_part: AtomicUsize,
    /// Helpers that have not finished the current job.
    busy: AtomicUsize,
    panicked: AtomicBool,
}

#[derive(Debug)]
struct Job {
    work: Option<Work>,
    parts: usize,
    end: bool,
}

// SAFETY: the pointer is read only between the beginning and the end of `Crew::run`, which borrows
// the closure for that long; the closure itself is `Sync`.
unsafe impl Send for Job {}

impl Crew {
    /// A crew of `threads`, the calling one included.
    ///
    /// # Panics
    /// If the system refuses a thread.
    #[must_use]
    pub fn new(threads: usize) -> Self {
        let shared = Arc::new(Shared {
            number: AtomicU32::new(0),
            job: Mutex::new(Job { work: None, parts: 0, end: false }),
            begun: Condvar::new(),
            next_part: AtomicUsize::new(0),
            busy: AtomicUsize::new(0),
            panicked: AtomicBool::new(false),
        });
        let helper = |index: usize| {
            let shared = Arc::clone(&shared);
            let name = format!("update-{index}");
            thread::Builder::new().name(name).spawn(move || shared.help()).expect("a thread")
        };
        let helpers = (1..threads).map(helper).collect();
        Self { shared, helpers }
    }

    /// Calls `work` once for each of `parts`, in any order and on any thread; returns when all are
    /// done.
    ///
    /// # Panics
    /// If `work` does.
    pub fn run(&self, parts: usize, work: &(dyn Fn(usize) + Sync)) {
        if self.helpers.is_empty() || parts < 2 {
            return (0..parts).for_each(work);
        }
        let shared = &*self.shared;
        shared.next_part.store(0, Ordering::Relaxed);
        shared.busy.store(self.helpers.len(), Ordering::Relaxed);
        // SAFETY: only the lifetime changes. Before this function returns, `busy` is zero: no
        // helper holds the pointer any more, and none takes it up again.
        let lent: &'static (dyn Fn(usize) + Sync) = unsafe { std::mem::transmute(work) };
        let mut job = shared.lock();
        (job.work, job.parts) = (Some(std::ptr::from_ref(lent)), parts);
        shared.number.fetch_add(1, Ordering::Release);
        drop(job);
        shared.begun.notify_all();
        let finish = Finish(shared);
        shared.take_parts(parts, work);
        drop(finish);
        assert!(!shared.panicked.swap(false, Ordering::AcqRel), "a thread of the update panicked");
    }

    /// Calls `work` once for each item.
    pub fn each<T: Send>(&self, items: &mut [T], work: impl Fn(&mut T) + Sync) {
        let items = Disjoint::new(items);
        self.run(items.len(), &|index| {
            // SAFETY: `run` hands out every index once.
            let item = unsafe { items.slice(index..index + 1) };
            work(&mut item[0]);
        });
    }
}

/// Waits for the helpers, also when the calling thread's own part panics: they hold a borrow.
struct Finish<'a>(&'a Shared);

impl Drop for Finish<'_> {
    fn drop(&mut self) {
        let mut spins = 0;
        while self.0.busy.load(Ordering::Acquire) > 0 {
            spins += 1;
            if spins < SPINS {
                std::hint::spin_loop();
            } else {
                // More threads than free cores: let the one we wait for have ours.
                thread::yield_now();
            }
        }
    }
}

impl Drop for Crew {
    fn drop(&mut self) {
        self.shared.lock().end = true;
        self.shared.number.fetch_add(1, Ordering::Release);
        self.shared.begun.notify_all();
        for helper in self.helpers.drain(..) {
            // A helper that panicked has been told of in `run`.
            let _ = helper.join();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Job> {
        self.job.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn take_parts(&self, parts: usize, work: &(dyn Fn(usize) + Sync)) {
        loop {
            let part = self.next_part.fetch_add(1, Ordering::Relaxed);
            if part >= parts {
                return;
            }
            work(part);
        }
    }

    /// A helper's life.
    fn help(&self) {
        let mut seen = 0;
        loop {
            let mut spins = 0;
            while self.number.load(Ordering::Acquire) == seen && spins < SPINS {
                spins += 1;
                std::hint::spin_loop();
            }
            let mut job = self.lock();
            while self.number.load(Ordering::Acquire) == seen {
                job = self.begun.wait(job).unwrap_or_else(PoisonError::into_inner);
            }
            seen = self.number.load(Ordering::Acquire);
            let (work, parts, end) = (job.work, job.parts, job.end);
            drop(job);
            if end {
                return;
            }
            if let Some(work) = work {
                // SAFETY: `run` waits for `busy` to fall, so the closure is still borrowed.
                let work = unsafe { &*work };
                let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                    self.take_parts(parts, work);
                }));
                if done.is_err() {
                    self.panicked.store(true, Ordering::Release);
                }
            }
            self.busy.fetch_sub(1, Ordering::Release);
        }
    }
}

/// A mutable slice whose disjoint ranges different threads work on.
pub struct Disjoint<'a, T> {
    pointer: *mut T,
    len: usize,
    borrowed: std::marker::PhantomData<&'a mut [T]>,
}

// SAFETY: it hands out `&mut T` to different threads, which `T: Send` allows; that no two overlap
// is the promise of whoever calls `slice`.
unsafe impl<T: Send> Sync for Disjoint<'_, T> {}

impl<'a, T> Disjoint<'a, T> {
    /// Borrows the slice.
    pub fn new(slice: &'a mut [T]) -> Self {
        let (pointer, len) = (slice.as_mut_ptr(), slice.len());
        Self { pointer, len, borrowed: std::marker::PhantomData }
    }

    /// Length of the whole.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is nothing.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// One range.
    ///
    /// # Safety
    /// No two ranges that live at the same time overlap.
    ///
    /// # Panics
    /// If the range does not lie inside.
    #[must_use]
    #[expect(clippy::mut_from_ref, reason = "that is its purpose; see Safety")]
    pub unsafe fn slice(&self, range: std::ops::Range<usize>) -> &mut [T] {
        assert!(range.start <= range.end && range.end <= self.len, "{range:?} of {}", self.len);
        // SAFETY: inside the borrowed slice, and the caller promises that nothing overlaps.
        unsafe { std::slice::from_raw_parts_mut(self.pointer.add(range.start), range.len()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_is_done_once_whatever_the_number_of_threads() {
        for threads in [1, 2, 3, 9] {
            let crew = Crew::new(threads);
            let mut counts = vec![0_u32; 37];
            (0..200).for_each(|_| crew.each(&mut counts, |count| *count += 1));
            assert!(counts.iter().all(|&count| count == 200), "{threads}: {counts:?}");
        }
    }

    #[test]
    fn a_panic_in_a_part_reaches_the_caller_and_the_crew_goes_on() {
        let crew = Crew::new(3);
        let run = |bad: usize| {
            std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                crew.run(8, &|part| assert_ne!(part, bad));
            }))
        };
        assert!((0..8).all(|bad| run(bad).is_err()));
        assert!(run(8).is_ok());
    }
}
