//! Progress of a benchmark: a bar in a terminal, a line per round elsewhere.

use std::io::IsTerminal;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use super::say;

/// Interval between two redraws.
const REDRAW_EVERY: Duration = Duration::from_millis(200);

/// Shows the current round and measurement.
pub struct RoundsProgress {
    bar: Option<ProgressBar>,
    rounds: usize,
}

impl RoundsProgress {
    /// Creates the display on standard error.
    #[must_use]
    pub fn new(rounds: usize) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(rounds as u64);
            let template = "{spinner:.cyan} {bar:20.cyan/dim} {pos}/{len} {wide_msg}";
            // The template is a constant; if it were invalid, indicatif's default would be used.
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style.progress_chars("━━╌"));
            }
            bar.enable_steady_tick(REDRAW_EVERY);
            bar
        });
        Self { bar, rounds }
    }

    /// Shows the current preparation.
    pub fn preparing(&self, what: &str) {
        match &self.bar {
            Some(bar) => bar.set_message(what.to_owned()),
            None => say(what),
        }
    }

    /// Shows the round that begins, counted from 0.
    pub fn round(&self, round: usize) {
        match &self.bar {
            Some(bar) => bar.set_position(round as u64),
            None => say(&format!("round {} of {}", round + 1, self.rounds)),
        }
    }

    /// Shows the current measurement; not printed as a line.
    pub fn measuring(&self, name: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(name.to_owned());
        }
    }
}

impl Drop for RoundsProgress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
