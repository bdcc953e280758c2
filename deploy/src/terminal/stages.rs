//! Progress of work in stages: a bar in a terminal, a line a stage elsewhere.

use std::io::IsTerminal;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use super::say;

/// Between two redraws.
const REDRAW_EVERY: Duration = Duration::from_millis(200);

/// Shows which stage it is and how far.
pub struct StagesProgress {
    bar: Option<ProgressBar>,
}

impl Default for StagesProgress {
    fn default() -> Self {
        Self::new()
    }
}

impl StagesProgress {
    /// On standard error.
    #[must_use]
    pub fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(0);
            let template = "{spinner:.cyan} {bar:20.cyan/dim} {percent:>3}% {wide_msg}";
            // The template is a constant; were it wrong, indicatif's own would do.
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style.progress_chars("━━╌"));
            }
            bar.enable_steady_tick(REDRAW_EVERY);
            bar
        });
        Self { bar }
    }

    /// What goes on from now on.
    pub fn stage(&self, what: &str) {
        match &self.bar {
            Some(bar) => {
                bar.set_position(0);
                bar.set_message(what.to_owned());
            }
            None => say(what),
        }
    }

    /// How far it is; too much for lines.
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
