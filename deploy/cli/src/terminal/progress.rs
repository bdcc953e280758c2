//! Shows the progress of a long operation: a bar in a terminal, occasional lines elsewhere.

use std::cell::{Cell, OnceCell};
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use dmprl_run::Progress;
use indicatif::{ProgressBar, ProgressStyle};

use super::messages::{say, says_json};

/// Interval between two lines of [`Progress::state`] without a terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(10);
/// Interval between two redraws.
const REDRAW_INTERVAL: Duration = Duration::from_millis(200);
/// Template before the amount of work is known.
const SPINNER: &str = "{spinner:.cyan} {wide_msg}";
/// Template once it is known.
const BAR: &str = "{spinner:.cyan} {bar:20.cyan/dim} {pos}/{len} {wide_msg}";

/// Progress on standard error. The bar appears with the first call and disappears on drop.
#[derive(Default)]
pub struct TerminalProgress {
    bar: OnceCell<Option<ProgressBar>>,
    has_length: Cell<bool>,
    printed: Cell<Option<Instant>>,
}

impl TerminalProgress {
    fn bar(&self) -> Option<&ProgressBar> {
        let bar = self.bar.get_or_init(|| {
            let draws = std::io::stderr().is_terminal() && !says_json();
            draws.then(|| {
                let bar = styled(ProgressBar::new_spinner(), SPINNER);
                bar.enable_steady_tick(REDRAW_INTERVAL);
                bar
            })
        });
        bar.as_ref()
    }
}

impl Progress for TerminalProgress {
    fn stage(&self, what: &str) {
        match self.bar() {
            Some(bar) => {
                bar.set_position(0);
                bar.set_message(what.to_owned());
            }
            None => say(what),
        }
    }

    fn detail(&self, what: &str) {
        if let Some(bar) = self.bar() {
            bar.set_message(what.to_owned());
        }
    }

    fn at(&self, done: u64, of: u64) {
        if let Some(bar) = self.bar() {
            if !self.has_length.replace(true) {
                styled(bar.clone(), BAR);
            }
            bar.set_length(of.max(1));
            bar.set_position(done.min(of));
        }
    }

    fn state(&self, what: &str) {
        if let Some(bar) = self.bar() {
            bar.set_message(what.to_owned());
        } else if self.printed.get().is_none_or(|at| at.elapsed() >= LINE_INTERVAL) {
            self.printed.set(Some(Instant::now()));
            say(what);
        }
    }

    fn print(&self, line: &str) {
        match self.bar() {
            Some(bar) => bar.suspend(|| say(line)),
            None => say(line),
        }
    }
}

impl Drop for TerminalProgress {
    fn drop(&mut self) {
        if let Some(Some(bar)) = self.bar.get() {
            bar.finish_and_clear();
        }
    }
}

fn styled(bar: ProgressBar, template: &str) -> ProgressBar {
    // The templates are constants; if one were invalid, indicatif's default would be used.
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style.progress_chars("━━╌"));
    }
    bar
}
