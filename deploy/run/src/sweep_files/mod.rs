//! The files of a sweep: the sweep file, the plan of its runs, the list of finished runs, and the
//! trials of a search. Sweeps write them; sweeps and reports read them.

mod file;
mod ledger;
mod plan;
mod search;
mod space;
mod study;
mod trial;

pub use file::{MethodEntry, SweepFile, TaskEntry, flatten};
pub use ledger::{End, Finished, Ledger};
pub use plan::{Plan, PlannedRun};
pub use search::{Objective, Pruner, Sampler, Search};
pub use space::{Domain, Parameter};
pub use study::{Found, Study, TUNING_SEED, found};
pub use trial::{StoredTrial, Trial, TrialState};
