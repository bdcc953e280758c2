//! Heartbeats of a worker.
//!
//! Every second a thread sends a heartbeat if the worker's loop has completed a round or is in a
//! call into the environments; the watchdog limits the duration of such a call. So a worker that
//! waits for its learner, or has a slow environment, still sends heartbeats. A worker that is
//! suspended, or whose loop hangs anywhere else, sends none, and the supervisor detects it.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::Context;

use crate::{Activity, ControlPipe, Report};

/// Interval between two heartbeats.
const BEAT: Duration = Duration::from_secs(1);

/// State of a worker's loop, which the heartbeat thread reads.
#[derive(Debug)]
pub struct Pulse {
    /// Number of rounds and, in the two lowest bits, the activity.
    state: AtomicU64,
    /// Segments that the learner has not acknowledged.
    kept: AtomicU64,
}

impl Pulse {
    /// Creates the state of a loop that has not started.
    #[must_use]
    pub fn new(doing: Activity) -> Self {
        Self { state: AtomicU64::new(bits(doing)), kept: AtomicU64::new(0) }
    }

    /// Records a round of the loop. Call it only from the loop's thread.
    pub fn beat(&self, doing: Activity) {
        // Relaxed, because this value does not guard any other memory.
        let number = (self.state.load(Ordering::Relaxed) >> 2).wrapping_add(1);
        self.state.store(number << 2 | bits(doing), Ordering::Relaxed);
    }

    /// Records the number of retained segments.
    pub fn set_kept(&self, segments: u64) {
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

/// Starts the thread that sends heartbeats. It ends when the supervisor is gone or the worker's
/// environments are closed.
///
/// - `calling`: returns whether a call into the environments is running; `None` once they are
///   closed.
///
/// # Errors
/// The thread cannot be started.
pub fn start_heartbeat(
    control: &ControlPipe,
    calling: impl Fn() -> Option<bool> + Send + 'static,
) -> anyhow::Result<()> {
    let (pulse, reporter) = (control.pulse(), control.reporter());
    let run = move || {
        let mut last = None;
        while let Some(calling) = calling() {
            let (state, doing) = pulse.state();
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_round_changes_the_state_and_records_the_activity() {
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
