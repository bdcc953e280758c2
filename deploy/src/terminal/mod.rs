//! Stage 8 of 8, on screen: progress, messages and the summary.
//!
//! All of it goes to standard error; standard output is for results.

mod count;
mod display;
mod format;
mod panel;
mod rounds;
mod setup;
mod stages;
mod summary;
mod sweep;
mod trial;

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

/// Prints a line on standard error. Unlike `eprintln!` it does not panic if writing fails, for
/// instance after a terminal was closed or on a full disk.
pub fn say(text: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "{text}");
}
