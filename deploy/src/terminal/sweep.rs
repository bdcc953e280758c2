//! Progress of a sweep: a bar in a terminal, a line per run elsewhere.

use std::io::IsTerminal;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use super::{duration, say};

/// Interval between two redraws.
const REDRAW_EVERY: Duration = Duration::from_millis(200);

/// Shows the number of ended runs or trials, and the remaining time.
pub struct SweepProgress {
    bar: Option<ProgressBar>,
    what: &'static str,
    count: usize,
    ended: usize,
}

impl SweepProgress {
    /// Creates the display on standard error; `ended` of `count` items had already ended.
    ///
    /// - `what`: the items' plural, such as `runs`.
    #[must_use]
    pub fn new(what: &'static str, count: usize, ended: usize) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(count as u64);
            let template = format!(
                "{{spinner:.cyan}} {{bar:20.cyan/dim}} {{pos}}/{{len}} {what} {{wide_msg}}"
            );
            // The template is a constant; if it were invalid, indicatif's default would be used.
            if let Ok(style) = ProgressStyle::with_template(&template) {
                bar.set_style(style.progress_chars("━━╌"));
            }
            bar.set_position(ended as u64);
            bar.enable_steady_tick(REDRAW_EVERY);
            bar
        });
        Self { bar, what, count, ended }
    }

    /// Sets the number of items that had already ended.
    pub fn begin_at(&mut self, ended: usize) {
        self.ended = ended;
        if let Some(bar) = &self.bar {
            bar.set_position(ended as u64);
        }
    }

    /// Prints a message above the bar.
    pub fn message(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| say(text)),
            None => say(text),
        }
    }

    /// Counts an ended item and shows the remaining time.
    pub fn ended(&mut self, remaining: Option<Duration>) {
        self.ended += 1;
        match &self.bar {
            Some(bar) => bar.set_position(self.ended as u64),
            None if self.ended < self.count => {
                let Self { what, count, ended, .. } = self;
                say(&format!("{ended} of {count} {what}; {}", left(remaining)));
            }
            None => {}
        }
        self.remaining(remaining);
    }

    /// Shows the remaining time; unknown until the first run has made steps.
    pub fn remaining(&self, remaining: Option<Duration>) {
        if let Some(bar) = &self.bar {
            bar.set_message(left(remaining));
        }
    }

    /// Removes the bar.
    pub fn close(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

fn left(remaining: Option<Duration>) -> String {
    remaining.map_or_else(String::new, |time| format!("about {} left", duration(time)))
}
