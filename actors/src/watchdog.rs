//! Stage 3 of 8, the watchdog: detects a call into the environments that does not return.
//!
//! A hanging environment may hold the GIL forever, so code that needs the GIL cannot detect it, and
//! no exception can end it. The watchdog's thread does not use Python: the caller records when a
//! call starts and ends, and the thread checks periodically whether the same call is still running.
//! Started by `environments::watch`.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

/// Number of checks after which a call counts as hanging. The thread counts checks instead of
/// reading a clock, so that a suspended process (Ctrl-Z, a paused container) is not mistaken for a
/// hanging one.
const CHECKS_MAX: u32 = 4;

/// Kind of a call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CallKind {
    /// `reset`.
    Reset = 1,
    /// `step_segment`.
    StepSegment = 2,
    /// `relabel`.
    Relabel = 3,
}

impl CallKind {
    /// The method's name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Reset => "reset",
            Self::StepSegment => "step_segment",
            Self::Relabel => "relabel",
        }
    }
}

/// The current call: its number and, in the two lowest bits, its kind or 0. One thread makes all
/// calls.
#[derive(Debug, Default)]
pub struct CallState(AtomicU64);

/// A running call; dropping it records that the call has returned.
#[derive(Debug)]
pub struct RunningCall<'a>(&'a CallState);

impl CallState {
    /// Records the start of a call.
    pub fn enter(&self, kind: CallKind) -> RunningCall<'_> {
        // Relaxed, because this value does not guard any other memory.
        let number = (self.0.load(Ordering::Relaxed) >> 2) + 1;
        self.0.store(number << 2 | kind as u64, Ordering::Relaxed);
        RunningCall(self)
    }

    /// Returns true if a call is running.
    #[must_use]
    pub fn is_running(&self) -> bool {
        self.0.load(Ordering::Relaxed) & 3 != 0
    }
}

impl Drop for RunningCall<'_> {
    fn drop(&mut self) {
        let state = self.0.0.load(Ordering::Relaxed);
        self.0.0.store(state & !3, Ordering::Relaxed);
    }
}

/// A call that does not return.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Hang {
    /// Kind of the call.
    pub kind: CallKind,
    /// Minimum time that it has lasted.
    pub lasted: Duration,
}

/// Starts the watchdog's thread. It calls `hung` once, after a call has lasted for `timeout` to
/// 1.25 `timeout`. It ends when `calls` is dropped.
///
/// # Errors
/// If the thread cannot be started.
pub fn watch(
    calls: &Arc<CallState>,
    timeout: Duration,
    hung: impl FnOnce(Hang) + Send + 'static,
) -> std::io::Result<()> {
    let calls = Arc::downgrade(calls);
    let pause = timeout / CHECKS_MAX;
    let thread = thread::Builder::new().name("watchdog".into());
    let run = move || {
        let mut checks = Checks::default();
        loop {
            thread::sleep(pause);
            let Some(calls) = calls.upgrade() else { return };
            if let Some(kind) = checks.check(calls.0.load(Ordering::Relaxed)) {
                return hung(Hang { kind, lasted: pause * CHECKS_MAX });
            }
        }
    };
    thread.spawn(run).map(drop)
}

/// The last state, and the number of checks since it changed.
#[derive(Debug, Default)]
struct Checks {
    state: u64,
    count: u32,
}

impl Checks {
    /// Checks the state; returns the kind of the current call if it hangs.
    fn check(&mut self, state: u64) -> Option<CallKind> {
        let kind = match state & 3 {
            1 => CallKind::Reset,
            2 => CallKind::StepSegment,
            3 => CallKind::Relabel,
            _ => {
                *self = Self { state, count: 0 };
                return None;
            }
        };
        self.count = if state == self.state { self.count + 1 } else { 0 };
        self.state = state;
        (self.count >= CHECKS_MAX).then_some(kind)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;

    const PATIENCE: Duration = Duration::from_secs(60);

    #[test]
    fn a_call_hangs_if_it_does_not_change_between_checks() {
        let calls = CallState::default();
        let mut checks = Checks::default();
        let mut check = || checks.check(calls.0.load(Ordering::Relaxed));
        for _ in 0..10 {
            assert_eq!(check(), None, "no call is running");
        }
        for _ in 0..10 {
            let call = calls.enter(CallKind::StepSegment);
            let seen: Vec<_> = (0..CHECKS_MAX).map(|_| check()).collect();
            assert_eq!(seen, [None; CHECKS_MAX as usize], "it returns in time");
            drop(call);
        }
        // `relabel` was not watched once, so a reward that never returned blocked its worker.
        for kind in [CallKind::Reset, CallKind::StepSegment, CallKind::Relabel] {
            let _call = calls.enter(kind);
            assert_eq!((0..CHECKS_MAX).filter_map(|_| check()).count(), 0);
            assert_eq!(check(), Some(kind));
        }
    }

    #[test]
    fn the_thread_reports_a_call_that_does_not_return() {
        let calls = Arc::new(CallState::default());
        let (sender, hangs) = mpsc::channel();
        let timeout = Duration::from_millis(40);
        watch(&calls, timeout, move |hang| sender.send(hang).unwrap()).unwrap();
        let _call = calls.enter(CallKind::StepSegment);
        let hang = hangs.recv_timeout(PATIENCE).unwrap();
        assert_eq!(hang, Hang { kind: CallKind::StepSegment, lasted: timeout });
    }

    #[test]
    fn the_thread_ends_when_the_call_state_is_dropped() {
        let calls = Arc::new(CallState::default());
        let (sender, ended) = mpsc::channel::<()>();
        watch(&calls, Duration::from_millis(4), move |_| drop(sender)).unwrap();
        drop(calls);
        // The thread drops the closure, and with it the sender.
        assert_eq!(ended.recv_timeout(PATIENCE), Err(mpsc::RecvTimeoutError::Disconnected));
    }
}
