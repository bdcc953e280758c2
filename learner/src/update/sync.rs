//! Types with which the thread pool synchronises. `tests/loom` compiles the pool with loom's types
//! instead, which run every order of its threads.

pub(super) use std::hint::spin_loop;
pub(super) use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};
pub(super) use std::sync::{Arc, Condvar, Mutex, MutexGuard};
pub(super) use std::thread::{self, JoinHandle};

/// Polls for a new job before a thread sleeps. They last about as long as the pauses between the
/// jobs of an update.
pub(super) const SPINS_MAX: u32 = 2_000;
