//! Progress of a sweep: a bar in a terminal, a line a run elsewhere.

use std::io::IsTerminal;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use super::{duration, say};

/// Between two redraws.
const REDRAW_EVERY: Duration = Duration::from_millis(200);

/// Shows how many runs, or trials, have ended and how long the others will take.
pub struct SweepProgress {
    bar: Option<ProgressBar>,
    what: &'static str,
    count: usize,
    ended: usize,
}

impl SweepProgress {
    /// On standard error; `ended` of so many were finished before.
    /// - `what`: their plural.
    #[must_use]
    pub fn new(what: &'static str, count: usize, ended: usize) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(count as u64);
            let template = format!(
                "{{spinner:.cyan}} {{bar:20.cyan/dim}} {{pos}}/{{len}} {what} {{wide_msg}}"
            );
            // The template is a constant; were it wrong, indicatif's own would do.
            if let Ok(style) = ProgressStyle::with_template(&template) {
                bar.set_style(style.progress_chars("━━╌"));
            }
            bar.set_position(ended as u64);
            bar.enable_steady_tick(REDRAW_EVERY);
            bar
        });
        Self { bar, what, count, ended }
    }

    /// So many had ended before.
    pub fn begin_at(&mut self, ended: usize) {
        self.ended = ended;
        if let Some(bar) = &self.bar {
            bar.set_position(ended as u64);
        }
    }

    /// Says something, above the bar.
    pub fn message(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| say(text)),
            None => say(text),
        }
    }

    /// One more has ended, and the others will take so long.
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

    /// The others will take so long; nothing is known before the first has begun to step.
    pub fn remaining(&self, remaining: Option<Duration>) {
        if let Some(bar) = &self.bar {
            bar.set_message(left(remaining));
        }
    }

    /// Takes the bar away.
    pub fn close(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

fn left(remaining: Option<Duration>) -> String {
    remaining.map_or_else(String::new, |time| format!("about {} left", duration(time)))
}
