//! Progress of a benchmark: a bar in a terminal, a line a round elsewhere.

use std::io::IsTerminal;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use super::say;

/// Between two redraws.
const REDRAW_EVERY: Duration = Duration::from_millis(200);

/// Shows which round it is and what is measured.
pub struct RoundsProgress {
    bar: Option<ProgressBar>,
    rounds: usize,
}

impl RoundsProgress {
    /// On standard error.
    #[must_use]
    pub fn new(rounds: usize) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(rounds as u64);
            let template = "{spinner:.cyan} {bar:20.cyan/dim} {pos}/{len} {wide_msg}";
            // The template is a constant; were it wrong, indicatif's own would do.
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style.progress_chars("━━╌"));
            }
            bar.enable_steady_tick(REDRAW_EVERY);
            bar
        });
        Self { bar, rounds }
    }

    /// What goes on before the first round.
    pub fn preparing(&self, what: &str) {
        match &self.bar {
            Some(bar) => bar.set_message(what.to_owned()),
            None => say(what),
        }
    }

    /// The round that begins, from 0.
    pub fn round(&self, round: usize) {
        match &self.bar {
            Some(bar) => bar.set_position(round as u64),
            None => say(&format!("round {} of {}", round + 1, self.rounds)),
        }
    }

    /// What is measured now; too much for lines.
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
