//! Stage 8 of 8, on screen: progress, messages and the summary.
//!
//! All of it goes to standard error; standard output is for results. `events.rs` writes the same as
//! JSON for other programs.

mod count;
mod display;
pub mod events;
mod format;
mod panel;
mod rounds;
mod setup;
mod stages;
mod summary;
mod sweep;
mod trial;

use std::sync::atomic::{AtomicBool, Ordering};

pub use count::CountProgress;
pub use display::{Display, ProgressStyle};
pub use format::{binary_bytes, duration, grouped, plus_minus, std_of};
pub use rounds::RoundsProgress;
pub use setup::SetupProgress;
pub use stages::StagesProgress;
pub(crate) use summary::shown;
pub use summary::summary;
pub use sweep::SweepProgress;
pub use trial::TrialProgress;

/// Whether [`say`] writes JSON, so that `--events json` leaves no other line on standard error.
static SAYS_JSON: AtomicBool = AtomicBool::new(false);

/// Makes [`say`] write events of the kind `message` from now on.
pub fn say_json() {
    SAYS_JSON.store(true, Ordering::Relaxed);
}

/// Whether [`say_json`] has been called.
#[must_use]
pub fn says_json() -> bool {
    SAYS_JSON.load(Ordering::Relaxed)
}

/// Prints a line on standard error. Unlike `eprintln!` it does not panic if writing fails, for
/// instance after a terminal was closed or on a full disk.
pub fn say(text: &str) {
    if says_json() { write_line(&events::message(text)) } else { write_line(text) }
}

/// Prints a line on standard error as it is.
pub(crate) fn write_line(line: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "{line}");
}
