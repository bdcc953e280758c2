//! Counts the allocations of all threads but the test harness's, so the tests of a binary that uses
//! it must be alone in it or run one after another.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

struct Counting;

static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);
/// The harness runs in the main thread, unless the test itself does (`--test-threads=1`).
static COUNTS_MAIN_THREAD: AtomicBool = AtomicBool::new(false);

thread_local! {
    /// Whether this is the main thread; `None` until the first allocation.
    static IS_MAIN_THREAD: Cell<Option<bool>> = const { Cell::new(None) };
}

// SAFETY: all calls are forwarded to the system allocator; the counter does not touch the memory.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if COUNTS_MAIN_THREAD.load(Ordering::Relaxed) || !is_main_thread() {
            ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        }
        // SAFETY: the caller's guarantees are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's guarantees are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn is_main_thread() -> bool {
    IS_MAIN_THREAD.with(|cached| {
        cached.get().unwrap_or_else(|| {
            // SAFETY: both calls only return numbers.
            let is_main = unsafe { libc::gettid() == libc::getpid() };
            cached.set(Some(is_main));
            is_main
        })
    })
}

/// Returns the number of allocations during `work`.
pub fn allocations_of(work: impl FnOnce()) -> u64 {
    COUNTS_MAIN_THREAD.store(is_main_thread(), Ordering::Relaxed);
    let before = ALLOCATIONS.load(Ordering::Relaxed);
    work();
    ALLOCATIONS.load(Ordering::Relaxed) - before
}
