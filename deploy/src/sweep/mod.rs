//! `dmprl sweep`: many runs from one file, side by side within the machine's cores.
//!
//! ```text
//!  FILE ─► plan: tasks × methods × grid × seeds ─► runner ─┬─ dmprl train, in OUTPUT/TASK/METHOD/
//!                         ▲                                └─ dmprl resume, where one was stopped
//!                     ledger: what has finished, and how long it took
//! ```
//! Each run is a `dmprl train` of its own, with the arguments that a person would type; nothing of
//! a run depends on the sweep around it. What has finished stands in `finished.jsonl`: a sweep that
//! was killed goes on where it was.

mod estimate;
mod file;
mod ledger;
mod plan;
mod runner;

pub use file::SweepFile;
pub use ledger::{Finished, Ledger};
pub use plan::{Plan, PlannedRun};
pub use runner::{RunState, Sweep, SweepReport, states, sweep};
