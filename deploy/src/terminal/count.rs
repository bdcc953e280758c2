//! Progress through a known number of items: a bar in a terminal, occasional lines elsewhere.

use std::cell::Cell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::say;

/// Interval between two lines without a terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);
/// Interval between two redraws.
const REDRAW_EVERY: Duration = Duration::from_millis(200);

/// Shows the number of completed items and the current one.
pub struct CountProgress {
    bar: Option<ProgressBar>,
    what: &'static str,
    count: u64,
    told: Cell<Option<Instant>>,
}

impl CountProgress {
    /// Creates the display on standard error.
    #[must_use]
    pub fn new(what: &'static str, count: u64) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(count);
            let template = "{spinner:.cyan} {bar:20.cyan/dim} {pos}/{len} {wide_msg}";
            // The template is a constant; if it were invalid, indicatif's default would be used.
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style.progress_chars("━━╌"));
            }
            bar.enable_steady_tick(REDRAW_EVERY);
            bar
        });
        Self { bar, what, count, told: Cell::new(None) }
    }

    /// Shows the item that begins, counted from 0.
    pub fn at(&self, index: u64, name: &str) {
        if let Some(bar) = &self.bar {
            bar.set_position(index);
            bar.set_message(format!("{}: {name}", self.what));
        } else if self.told.get().is_none_or(|at| at.elapsed() >= LINE_EVERY) {
            self.told.set(Some(Instant::now()));
            say(&format!("{} {} of {}: {name}", self.what, index + 1, self.count));
        }
    }
}

impl Drop for CountProgress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
