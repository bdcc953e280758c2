//! Progress of the Python set-up: a changing line in a terminal, occasional lines elsewhere.

use std::cell::Cell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::{say, says_json};

/// Interval between two plain lines.
const LINE_EVERY: Duration = Duration::from_secs(5);

/// Shows the messages of the set-up; silent if there is nothing to do.
pub struct SetupProgress {
    spinner: Option<ProgressBar>,
    line_at: Cell<Option<Instant>>,
}

impl Default for SetupProgress {
    fn default() -> Self {
        Self::new()
    }
}

impl SetupProgress {
    /// Creates the display on standard error.
    #[must_use]
    pub fn new() -> Self {
        let draws = std::io::stderr().is_terminal() && !says_json();
        let spinner = draws.then(|| {
            let spinner = ProgressBar::new_spinner();
            // The template is a constant; if it were invalid, indicatif's default would be used.
            if let Ok(style) = ProgressStyle::with_template("{spinner:.cyan} {wide_msg}") {
                spinner.set_style(style);
            }
            spinner
        });
        Self { spinner, line_at: Cell::new(None) }
    }

    /// Shows one line.
    pub fn show(&self, line: &str) {
        if let Some(spinner) = &self.spinner {
            spinner.set_message(line.to_owned());
            spinner.tick();
            return;
        }
        let now = Instant::now();
        if self.line_at.get().is_none_or(|at| now.duration_since(at) >= LINE_EVERY) {
            self.line_at.set(Some(now));
            say(line);
        }
    }
}

impl Drop for SetupProgress {
    fn drop(&mut self) {
        if let Some(spinner) = &self.spinner {
            spinner.finish_and_clear();
        }
    }
}
