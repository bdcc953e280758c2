//! `dmprl sweep`: many runs from one file, side by side within the machine's cores.
//!
//! ```text
//!  FILE ─► plan: tasks × methods × grid × seeds ─► runner ─┬─ dmprl train, in OUTPUT/TASK/METHOD/
//!                         ▲                                └─ dmprl resume, where one was stopped
//!                     ledger: what has finished, and how long it took
//! ```
//! Each run is a `dmprl train` of its own, with the arguments that a person would type; nothing of
//! a run depends on the sweep around it. What has finished stands in `finished.jsonl`: a sweep that
//! was killed goes on where it was. With `[search]` instead of a grid, `search` takes the place of
//! plan and runner.

mod estimate;
mod file;
mod ledger;
mod plan;
mod run;
mod runner;
pub mod search;

pub use file::SweepFile;
pub(crate) use file::flatten;
pub use ledger::{End, Finished, Ledger};
pub use plan::{Plan, PlannedRun};
pub use run::{RunState, Site};
pub use runner::{Sweep, SweepReport, states, sweep};
pub use search::Search;
