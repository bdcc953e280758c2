//! Progress of work in stages: a bar in a terminal, a line per stage elsewhere.

use std::io::IsTerminal;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use super::say;

/// Interval between two redraws.
const REDRAW_EVERY: Duration = Duration::from_millis(200);

/// Shows the current stage and its progress.
pub struct StagesProgress {
    bar: Option<ProgressBar>,
}

impl Default for StagesProgress {
    fn default() -> Self {
        Self::new()
    }
}

impl StagesProgress {
    /// Creates the display on standard error.
    #[must_use]
    pub fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(0);
            let template = "{spinner:.cyan} {bar:20.cyan/dim} {percent:>3}% {wide_msg}";
            // The template is a constant; if it were invalid, indicatif's default would be used.
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style.progress_chars("━━╌"));
            }
            bar.enable_steady_tick(REDRAW_EVERY);
            bar
        });
        Self { bar }
    }

    /// Shows the stage that begins.
    pub fn stage(&self, what: &str) {
        match &self.bar {
            Some(bar) => {
                bar.set_position(0);
                bar.set_message(what.to_owned());
            }
            None => say(what),
        }
    }

    /// Shows the progress of the stage; not printed as a line.
    pub fn at(&self, done: u64, of: u64) {
        if let Some(bar) = &self.bar {
            bar.set_length(of.max(1));
            bar.set_position(done.min(of));
        }
    }
}

impl Drop for StagesProgress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
