//! Longest time between two control steps.

use std::fmt;

/// Notices a caller that was frozen, by the time between two calls.
pub(super) struct Deadline {
    /// Longest time between two calls \[s\].
    limit_s: f64,
    /// Returns the time \[s\] since any moment.
    clock: Box<dyn Fn() -> f64 + Send>,
    called_at_s: Option<f64>,
}

impl Deadline {
    pub(super) fn new(limit_s: f64, clock: impl Fn() -> f64 + Send + 'static) -> Self {
        Self { limit_s, clock: Box::new(clock), called_at_s: None }
    }

    /// Records a call. Returns whether it comes too late after the previous one.
    pub(super) fn is_late(&mut self) -> bool {
        let now_s = (self.clock)();
        let before_s = self.called_at_s.replace(now_s);
        // A clock that goes backwards or returns NaN measures nothing, so the call counts as late.
        before_s.is_some_and(|before_s| !(0.0..=self.limit_s).contains(&(now_s - before_s)))
    }

    /// Forgets the previous call, for a new episode.
    pub(super) fn restart(&mut self) {
        self.called_at_s = None;
    }
}

impl fmt::Debug for Deadline {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { limit_s, called_at_s, .. } = self;
        let mut shown = formatter.debug_struct("Deadline");
        shown.field("limit_s", limit_s).field("called_at_s", called_at_s).finish_non_exhaustive()
    }
}
