//! `dmprl sweep`: trains many runs from one file, in parallel on the cores of one machine.
//!
//! ```text
//!  FILE ─► plan: tasks × methods × grid × seeds ─► runner ─┬─ dmprl train, in OUTPUT/TASK/METHOD/
//!                         ▲                                └─ dmprl resume, where one was stopped
//!                     ledger: finished runs and their training time
//! ```
//! Each run is a separate `dmprl train` process, with the arguments that a user would type.
//! Finished runs are recorded in `finished.jsonl`, so that a killed sweep continues where it
//! stopped. If the file has `[search]` instead of `[grid]`, `search` replaces plan and runner.

mod estimate;
pub mod record;
mod run;
mod runner;
pub mod search;
mod tally;

pub use run::{RunState, Site};
pub use runner::{Sweep, SweepReport, states, sweep};
