//! Progress of a trial: a line in a terminal, a line every few seconds elsewhere.

use std::cell::Cell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::format::duration;
use super::say;

/// Between two lines where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);
/// Between two redraws.
const REDRAW_EVERY: Duration = Duration::from_millis(200);

/// Shows how far a trial has come and what has happened.
pub struct TrialProgress {
    bar: Option<ProgressBar>,
    total: Duration,
    told: Cell<Option<Instant>>,
}

impl TrialProgress {
    /// On standard error.
    #[must_use]
    pub fn new(total: Duration) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(total.as_secs());
            // The template is a constant; were it wrong, indicatif's own would do.
            if let Ok(style) = ProgressStyle::with_template("{spinner:.cyan} {wide_msg}") {
                bar.set_style(style);
            }
            bar.enable_steady_tick(REDRAW_EVERY);
            bar
        });
        Self { bar, total, told: Cell::new(None) }
    }

    /// Where it stands.
    pub fn tell(&self, done: Duration, what: &str) {
        let line = format!("{}/{} {what}", duration(done), duration(self.total));
        if let Some(bar) = &self.bar {
            bar.set_message(line);
        } else if self.told.get().is_none_or(|at| at.elapsed() >= LINE_EVERY) {
            self.told.set(Some(Instant::now()));
            say(&line);
        }
    }
}

impl Drop for TrialProgress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
