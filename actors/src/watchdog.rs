//! Notices a call into the environments that does not return.
//!
//! An environment that hangs may hold the interpreter's lock for ever, so nothing that needs the
//! lock can notice it and no exception can end it. This thread needs nothing of Python: the caller
//! notes when a call begins and ends, and the thread looks now and then whether it is still the
//! same one.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

/// Looks at one call, a pause between each two, before it counts as hanging. Looks are counted and
/// no clock is read: while the whole process stands still (Ctrl-Z, a paused container) one pause
/// passes at most.
const LOOKS_MAX: u32 = 4;

/// What a call asks for.
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

/// The call that is under way: its number and, in the two lowest bits, its kind or none. One thread
/// makes the calls.
#[derive(Debug, Default)]
pub struct CallState(AtomicU64);

/// A call; dropped, it has returned.
#[derive(Debug)]
pub struct RunningCall<'a>(&'a CallState);

impl CallState {
    /// Notes that a call begins.
    pub fn enter(&self, kind: CallKind) -> RunningCall<'_> {
        // The thread compares numbers and reads no other memory: no order is needed.
        let number = (self.0.load(Ordering::Relaxed) >> 2) + 1;
        self.0.store(number << 2 | kind as u64, Ordering::Relaxed);
        RunningCall(self)
    }

    /// Whether a call is under way.
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
    /// What it was to do.
    pub kind: CallKind,
    /// It has lasted so long at least.
    pub lasted: Duration,
}

/// Starts the thread. It calls `hung` once, when a call has lasted for `timeout` or up to a quarter
/// longer, and ends when nobody makes calls any more.
///
/// # Errors
/// The thread cannot be started.
pub fn watch(
    calls: &Arc<CallState>,
    timeout: Duration,
    hung: impl FnOnce(Hang) + Send + 'static,
) -> std::io::Result<()> {
    let calls = Arc::downgrade(calls);
    let pause = timeout / LOOKS_MAX;
    let thread = thread::Builder::new().name("watchdog".into());
    let run = move || {
        let mut looks = Looks::default();
        loop {
            thread::sleep(pause);
            let Some(calls) = calls.upgrade() else { return };
            if let Some(kind) = looks.look(calls.0.load(Ordering::Relaxed)) {
                return hung(Hang { kind, lasted: pause * LOOKS_MAX });
            }
        }
    };
    thread.spawn(run).map(drop)
}

/// The state seen last, and how often since it was new.
#[derive(Debug, Default)]
struct Looks {
    state: u64,
    count: u32,
}

impl Looks {
    /// The kind of a call that hangs.
    fn look(&mut self, state: u64) -> Option<CallKind> {
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
        (self.count >= LOOKS_MAX).then_some(kind)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;

    const PATIENCE: Duration = Duration::from_secs(60);

    #[test]
    fn a_call_that_stays_the_same_hangs_and_one_that_is_followed_by_another_does_not() {
        let calls = CallState::default();
        let mut looks = Looks::default();
        let mut look = || looks.look(calls.0.load(Ordering::Relaxed));
        for _ in 0..10 {
            assert_eq!(look(), None, "no call is under way");
        }
        for _ in 0..10 {
            let call = calls.enter(CallKind::StepSegment);
            let seen: Vec<_> = (0..LOOKS_MAX).map(|_| look()).collect();
            assert_eq!(seen, [None; LOOKS_MAX as usize], "it returns in time");
            drop(call);
        }
        // `relabel` was once not looked at: a reward that never returned held its worker for ever.
        for kind in [CallKind::Reset, CallKind::StepSegment, CallKind::Relabel] {
            let _call = calls.enter(kind);
            assert_eq!((0..LOOKS_MAX).filter_map(|_| look()).count(), 0);
            assert_eq!(look(), Some(kind));
        }
    }

    #[test]
    fn the_thread_tells_of_a_call_that_does_not_return() {
        let calls = Arc::new(CallState::default());
        let (sender, hangs) = mpsc::channel();
        let timeout = Duration::from_millis(40);
        watch(&calls, timeout, move |hang| sender.send(hang).unwrap()).unwrap();
        let _call = calls.enter(CallKind::StepSegment);
        let hang = hangs.recv_timeout(PATIENCE).unwrap();
        assert_eq!(hang, Hang { kind: CallKind::StepSegment, lasted: timeout });
    }

    #[test]
    fn the_thread_ends_with_what_it_watches() {
        let calls = Arc::new(CallState::default());
        let (sender, ended) = mpsc::channel::<()>();
        watch(&calls, Duration::from_millis(4), move |_| drop(sender)).unwrap();
        drop(calls);
        // Its end drops the closure, and with it the sender.
        assert_eq!(ended.recv_timeout(PATIENCE), Err(mpsc::RecvTimeoutError::Disconnected));
    }
}
