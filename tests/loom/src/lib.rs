//! The update's thread pool (`learner/src/update/thread_pool.rs`) with loom's types.

/// The pool.
#[path = "../../../learner/src/update/thread_pool.rs"]
pub mod thread_pool;

/// As `learner/src/update/sync.rs`.
mod sync {
    pub(super) use loom::hint::spin_loop;
    pub(super) use loom::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};
    pub(super) use loom::sync::{Arc, Condvar, Mutex, MutexGuard};
    pub(super) use loom::thread::{self, JoinHandle};

    /// One poll, since each multiplies the number of orders.
    pub(super) const SPINS_MAX: u32 = 1;
}
