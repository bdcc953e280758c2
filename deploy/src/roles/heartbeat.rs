//! A worker's signs of life.
//!
//! A thread of its own sends one each second in which the worker's loop has come round, or in which
//! a call into the environments is under way: how long that may take is the watchdog's business.
//! So a worker that waits for its learner, however long, lives, and so does one with a slow
//! environment. One that is stopped, or whose loop stands still anywhere else, falls silent, and
//! the supervisor notices.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::control::Activity;

/// What a loop tells the thread.
#[derive(Debug)]
pub struct Pulse {
    /// How often it has come round, and in the two lowest bits what it did then.
    state: AtomicU64,
    /// Segments that the learner has not acknowledged.
    kept: AtomicU64,
}

impl Pulse {
    /// A loop that has not begun.
    #[must_use]
    pub fn new(doing: Activity) -> Self {
        Self { state: AtomicU64::new(bits(doing)), kept: AtomicU64::new(0) }
    }

    /// The loop has come round; from its thread only.
    pub fn beat(&self, doing: Activity) {
        // The other thread compares numbers and reads no other memory: no order is needed.
        let number = (self.state.load(Ordering::Relaxed) >> 2).wrapping_add(1);
        self.state.store(number << 2 | bits(doing), Ordering::Relaxed);
    }

    /// So many segments are kept.
    pub fn keep(&self, segments: u64) {
        self.kept.store(segments, Ordering::Relaxed);
    }

    fn state(&self) -> (u64, Activity) {
        let state = self.state.load(Ordering::Relaxed);
        let doing = match state & 3 {
            1 => Activity::Stepping,
            2 => Activity::Waiting,
            _ => Activity::Attaching,
        };
        (state, doing)
    }
}

fn bits(doing: Activity) -> u64 {
    match doing {
        Activity::Attaching => 0,
        Activity::Stepping => 1,
        Activity::Waiting => 2,
    }
}

#[cfg(feature = "python")]
pub use thread::start;

#[cfg(feature = "python")]
mod thread {
    use std::sync::Arc;
    use std::sync::atomic::Ordering;
    use std::time::Duration;

    use anyhow::Context;
    use dmprl_actors::watchdog::CallState;

    use crate::control::{Activity, Report};
    use crate::roles::ControlPipe;

    /// Between two signs of life.
    const BEAT: Duration = Duration::from_secs(1);

    /// Starts the thread. It ends when nobody makes calls any more, or nobody listens.
    pub fn start(control: &ControlPipe, calls: &Arc<CallState>) -> anyhow::Result<()> {
        let (pulse, reporter) = (control.pulse(), control.reporter());
        let calls = Arc::downgrade(calls);
        let run = move || {
            let mut last = None;
            while let Some(calls) = calls.upgrade() {
                let (state, doing) = pulse.state();
                let calling = calls.is_running();
                drop(calls);
                if calling || last != Some(state) {
                    let doing = if calling { Activity::Stepping } else { doing };
                    let kept = pulse.kept.load(Ordering::Relaxed);
                    if reporter.send(&Report::Alive { doing, kept }).is_err() {
                        return;
                    }
                }
                last = Some(state);
                std::thread::sleep(BEAT);
            }
        };
        let thread = std::thread::Builder::new().name("heartbeat".into());
        thread.spawn(run).map(drop).context("cannot start the heartbeat")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_round_is_another_state_and_says_what_was_done() {
        let pulse = Pulse::new(Activity::Attaching);
        let mut seen = vec![pulse.state()];
        for doing in
            [Activity::Stepping, Activity::Stepping, Activity::Waiting, Activity::Attaching]
        {
            pulse.beat(doing);
            assert_eq!(pulse.state().1, doing);
            seen.push(pulse.state());
        }
        seen.sort_by_key(|(state, _)| *state);
        seen.dedup_by_key(|(state, _)| *state);
        assert_eq!(seen.len(), 5);
    }
}
