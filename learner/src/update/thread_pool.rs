//! The threads of an update. A job consists of independent parts, which the threads share.
//!
//! Any thread may compute any part, but each begins with its own: in every job of an update the
//! same thread then computes the same rows, which are still in its core's cache. The result of a
//! part depends only on its index, and no two parts write the same result, so the number of threads
//! does not change a single bit.

use std::sync::PoisonError;

use super::sync::{
    Arc, AtomicBool, AtomicU32, AtomicUsize, Condvar, JoinHandle, Mutex, MutexGuard, Ordering,
    SPINS_MAX, spin_loop, thread,
};

/// A closure that computes one part, borrowed for the duration of one job.
type Work = *const (dyn Fn(usize) + Sync);

/// A fixed set of threads that run one job at a time.
///
/// Running a job needs `&mut self`, so the borrow checker rules out two jobs at once and a job
/// started from inside another. Neither starting nor finishing a job allocates.
#[derive(Debug)]
pub struct ThreadPool {
    shared: Arc<Shared>,
    helpers: Vec<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    /// Number of jobs started; each helper takes part in each job once.
    jobs_started: AtomicU32,
    job: Mutex<Job>,
    job_available: Condvar,
    /// Next part of each thread's own range. A thread that has finished its range takes parts from
    /// those of the others.
    next_parts: Box<[AtomicUsize]>,
    /// Helpers that have not finished the current job.
    busy: AtomicUsize,
    panicked: AtomicBool,
}

#[derive(Debug)]
struct Job {
    work: Option<Work>,
    parts: usize,
    shutdown: bool,
}

// SAFETY: helpers dereference the pointer only while `ThreadPool::run` waits for them, and `run`
// borrows the closure for that long. The closure itself is `Sync`.
unsafe impl Send for Job {}

impl ThreadPool {
    /// Starts a pool of `threads` threads, including the calling thread.
    ///
    /// # Panics
    /// If the operating system cannot start a thread.
    #[must_use]
    pub fn new(threads: usize) -> Self {
        let shared = Arc::new(Shared {
            jobs_started: AtomicU32::new(0),
            job: Mutex::new(Job { work: None, parts: 0, shutdown: false }),
            job_available: Condvar::new(),
            next_parts: (0..threads.max(1)).map(|_| AtomicUsize::new(0)).collect(),
            busy: AtomicUsize::new(0),
            panicked: AtomicBool::new(false),
        });
        let helper = |index: usize| {
            let shared = Arc::clone(&shared);
            let name = format!("update-{index}");
            let spawned = thread::Builder::new().name(name).spawn(move || shared.run_helper(index));
            spawned.expect("cannot start a thread of the update")
        };
        let helpers = (1..threads).map(helper).collect();
        Self { shared, helpers }
    }

    /// Calls `work` once with each index below `parts`, in any order and on any thread. Returns
    /// when all calls have returned.
    ///
    /// # Panics
    /// If `work` panics; the other threads finish their parts first.
    pub fn run(&mut self, parts: usize, work: &(dyn Fn(usize) + Sync)) {
        if self.helpers.is_empty() || parts < 2 {
            return (0..parts).for_each(work);
        }
        let shared = &*self.shared;
        for (thread, next) in shared.next_parts.iter().enumerate() {
            next.store(shared.range_start(thread, parts), Ordering::Relaxed);
        }
        shared.busy.store(self.helpers.len(), Ordering::Relaxed);
        // Set by a helper if the previous job panicked on the calling thread as well.
        shared.panicked.store(false, Ordering::Relaxed);
        // SAFETY: this changes only the lifetime. `&mut self` excludes a second job. When this
        // function returns or unwinds, `busy` is zero: no helper holds the pointer any more, and
        // none reads it again before the next job replaces it.
        let work_for_helpers: &'static (dyn Fn(usize) + Sync) =
            unsafe { std::mem::transmute(work) };
        let mut job = shared.lock();
        (job.work, job.parts) = (Some(std::ptr::from_ref(work_for_helpers)), parts);
        shared.jobs_started.fetch_add(1, Ordering::Release);
        drop(job);
        shared.job_available.notify_all();
        let wait = WaitForHelpers(shared);
        shared.take_parts(0, parts, work);
        drop(wait);
        assert!(!shared.panicked.load(Ordering::Acquire), "a thread of the update panicked");
    }

    /// Calls `work` once with each item.
    pub fn for_each<T: Send>(&mut self, items: &mut [T], work: impl Fn(&mut T) + Sync) {
        let items = DisjointSlice::new(items);
        self.run(items.len(), &|index| {
            // SAFETY: `run` passes each index once.
            let item = unsafe { items.slice(index..index + 1) };
            work(&mut item[0]);
        });
    }
}

/// Waits for the helpers when it is dropped. A job must not return before that, even if the calling
/// thread's own part panics, because the helpers still borrow the closure.
struct WaitForHelpers<'a>(&'a Shared);

impl Drop for WaitForHelpers<'_> {
    fn drop(&mut self) {
        let mut spins = 0;
        while self.0.busy.load(Ordering::Acquire) > 0 {
            spins += 1;
            if spins < SPINS_MAX {
                spin_loop();
            } else {
                // With more threads than free cores, the helper may need this core.
                thread::yield_now();
            }
        }
    }
}

impl Drop for ThreadPool {
    fn drop(&mut self) {
        let mut job = self.shared.lock();
        job.shutdown = true;
        // With the lock, as in `run`: a helper between its check and its wait would miss both this
        // number and the notification.
        self.shared.jobs_started.fetch_add(1, Ordering::Release);
        drop(job);
        self.shared.job_available.notify_all();
        for helper in self.helpers.drain(..) {
            // `run` has already reported a panic.
            let _ = helper.join();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Job> {
        self.job.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the first part of a thread's range. It ends where the next thread's begins.
    fn range_start(&self, thread: usize, parts: usize) -> usize {
        thread * parts / self.next_parts.len()
    }

    /// Computes the parts of the range of `thread`, then those that other threads have not begun.
    fn take_parts(&self, thread: usize, parts: usize, work: &(dyn Fn(usize) + Sync)) {
        let threads = self.next_parts.len();
        for owner in (thread..threads).chain(0..thread) {
            let end = self.range_start(owner + 1, parts);
            loop {
                let part = self.next_parts[owner].fetch_add(1, Ordering::Relaxed);
                if part >= end {
                    break;
                }
                work(part);
            }
        }
    }

    /// Takes part in every job until the pool is dropped.
    fn run_helper(&self, thread: usize) {
        let mut seen = 0;
        loop {
            let mut spins = 0;
            while self.jobs_started.load(Ordering::Acquire) == seen && spins < SPINS_MAX {
                spins += 1;
                spin_loop();
            }
            let mut job = self.lock();
            while self.jobs_started.load(Ordering::Acquire) == seen {
                job = self.job_available.wait(job).unwrap_or_else(PoisonError::into_inner);
            }
            seen = self.jobs_started.load(Ordering::Acquire);
            let (work, parts, shutdown) = (job.work, job.parts, job.shutdown);
            drop(job);
            if shutdown {
                return;
            }
            if let Some(work) = work {
                // SAFETY: `run` waits until `busy` is zero, so the closure is still borrowed.
                let work = unsafe { &*work };
                let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                    self.take_parts(thread, parts, work);
                }));
                if done.is_err() {
                    self.panicked.store(true, Ordering::Release);
                }
            }
            self.busy.fetch_sub(1, Ordering::Release);
        }
    }
}

/// A mutable slice of which several threads write disjoint ranges.
pub struct DisjointSlice<'a, T> {
    pointer: *mut T,
    len: usize,
    borrowed: std::marker::PhantomData<&'a mut [T]>,
}

// SAFETY: it hands out `&mut T` to several threads, which `T: Send` permits. Callers of `slice`
// guarantee that no two ranges overlap.
unsafe impl<T: Send> Sync for DisjointSlice<'_, T> {}

impl<'a, T> DisjointSlice<'a, T> {
    /// Borrows the slice.
    pub fn new(slice: &'a mut [T]) -> Self {
        let (pointer, len) = (slice.as_mut_ptr(), slice.len());
        Self { pointer, len, borrowed: std::marker::PhantomData }
    }

    /// Returns the length of the whole slice.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns whether the whole slice is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Returns one range of the slice.
    ///
    /// # Safety
    /// No two ranges that are in use at the same time may overlap.
    ///
    /// # Panics
    /// If the range is out of bounds.
    #[must_use]
    #[expect(clippy::mut_from_ref, reason = "that is its purpose; see Safety")]
    pub unsafe fn slice(&self, range: std::ops::Range<usize>) -> &mut [T] {
        assert!(range.start <= range.end && range.end <= self.len, "{range:?} of {}", self.len);
        // SAFETY: the range is within the borrowed slice, and the caller guarantees that it
        // overlaps with no other.
        unsafe { std::slice::from_raw_parts_mut(self.pointer.add(range.start), range.len()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_is_done_once_whatever_the_number_of_threads() {
        for threads in [1, 2, 3, 9] {
            let mut pool = ThreadPool::new(threads);
            let mut counts = vec![0_u32; 37];
            (0..200).for_each(|_| pool.for_each(&mut counts, |count| *count += 1));
            assert!(counts.iter().all(|&count| count == 200), "{threads}: {counts:?}");
        }
    }

    #[test]
    fn a_panic_in_a_part_reaches_the_caller_and_the_pool_remains_usable() {
        let mut pool = ThreadPool::new(3);
        let mut run = |work: &(dyn Fn(usize) + Sync)| {
            std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| pool.run(8, work)))
        };
        assert!((0..8).all(|bad| run(&|part| assert_ne!(part, bad)).is_err()));
        // The panic of a helper must not be reported for the next job.
        assert!(run(&|_| panic!("every thread")).is_err());
        assert!(run(&|_| ()).is_ok());
    }
}
