//! Progress of a chaos trial: a changing line in a terminal, periodic lines elsewhere.

use std::cell::Cell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::format::duration;
use super::say;

/// Interval between two lines without a terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);
/// Interval between two redraws.
const REDRAW_EVERY: Duration = Duration::from_millis(200);

/// Shows the elapsed time and the events of a trial.
pub struct TrialProgress {
    bar: Option<ProgressBar>,
    total: Duration,
    told: Cell<Option<Instant>>,
}

impl TrialProgress {
    /// Creates the display on standard error.
    #[must_use]
    pub fn new(total: Duration) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(total.as_secs());
            // The template is a constant; if it were invalid, indicatif's default would be used.
            if let Ok(style) = ProgressStyle::with_template("{spinner:.cyan} {wide_msg}") {
                bar.set_style(style);
            }
            bar.enable_steady_tick(REDRAW_EVERY);
            bar
        });
        Self { bar, total, told: Cell::new(None) }
    }

    /// Shows the current state.
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
