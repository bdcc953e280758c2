//! Stage 8 of 8, on screen: progress, messages and the summary.
//!
//! Everything goes to standard error; standard output is for results. `events.rs` writes the same
//! information as JSON for other programs.

mod display;
pub mod events;
pub mod messages;
mod panel;
mod progress;
mod summary;

pub use display::{Display, ProgressStyle};
pub use messages::{say, write_line};
pub use progress::TerminalProgress;
pub use summary::summary;
