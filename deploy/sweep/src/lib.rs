//! `dmprl sweep`: trains many runs from one file, in parallel within the machine's cores.
//!
//! ```text
//!  FILE ─► plan: tasks × methods × grid × seeds ─► runner ─┬─ dmprl train, in OUTPUT/TASK/METHOD/
//!                         ▲                                └─ dmprl resume, where one was stopped
//!                     ledger: what has finished, and how long it took
//! ```
//! Each run is a separate `dmprl train`, with the arguments that a user would type, and does not
//! depend on the sweep. Finished runs are recorded in `finished.jsonl`, so a killed sweep continues
//! where it stopped. With `[search]` instead of a grid, `search` replaces plan and runner.

mod estimate;
pub mod record;
mod run;
mod runner;
pub mod search;
mod tally;

pub use run::{RunState, Site};
pub use runner::{Sweep, SweepReport, states, sweep};
