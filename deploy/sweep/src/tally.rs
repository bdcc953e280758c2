//! Counts the runs or trials of a sweep and reports its progress.

use std::time::Duration;

use dmprl_run::Progress;
use dmprl_run::format::duration;

/// Counter of the ended runs or trials of a sweep.
pub(crate) struct Tally<'a> {
    progress: &'a dyn Progress,
    what: &'static str,
    count: usize,
    ended: usize,
}

impl<'a> Tally<'a> {
    /// Creates a tally of `count` items, of which `ended` have already ended.
    ///
    /// - `what`: name of the items in the plural, such as `runs`.
    pub(crate) fn new(
        progress: &'a dyn Progress,
        what: &'static str,
        count: usize,
        ended: usize,
    ) -> Self {
        let tally = Self { progress, what, count, ended };
        tally.show();
        tally
    }

    /// Sets the number of ended items.
    pub(crate) fn set_ended(&mut self, ended: usize) {
        self.ended = ended;
        self.show();
    }

    /// Prints a permanent line.
    pub(crate) fn message(&self, text: &str) {
        self.progress.print(text);
    }

    /// Counts an ended item and shows the remaining time.
    pub(crate) fn ended(&mut self, remaining: Option<Duration>) {
        self.ended += 1;
        let Self { progress, what, count, ended } = self;
        if ended < count {
            progress.stage(&format!("{ended} of {count} {what}; {}", time_left(remaining)));
        }
        self.show();
        self.remaining(remaining);
    }

    /// Shows the remaining time; `None` if it is unknown.
    pub(crate) fn remaining(&self, remaining: Option<Duration>) {
        let Self { progress, what, .. } = self;
        progress.detail(&format!("{what} {}", time_left(remaining)));
    }

    fn show(&self) {
        self.progress.at(self.ended as u64, self.count as u64);
    }
}

fn time_left(remaining: Option<Duration>) -> String {
    remaining.map_or_else(String::new, |time| format!("about {} left", duration(time)))
}
