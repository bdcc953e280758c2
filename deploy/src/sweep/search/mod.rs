//! `[search]`: values of configuration keys that Optuna proposes, trial by trial.
//!
//! ```text
//!  runner ── ask ──► dmprl.search (Optuna) ─► values ─► a trial: dmprl train, seed after seed
//!    │  ◄─ give up? ─┘     │                                │
//!    └── report, tell ─────┘ ◄────── evaluations.jsonl ─────┘
//! ```
//! Optuna's storage, `optuna.db`, has the last word on what was tried and what came of it: a search
//! that was killed goes on with the trials that it finds under way there, from their runs'
//! checkpoints. `trial.json` in each trial's folder says the same for listings and reports, which
//! need no Python. A trial's runs are trained seed after seed, so that a bad one costs part of one.

mod endings;
mod file;
mod optuna;
mod remaining;
mod runner;
mod space;
mod study;
mod trial;

pub use file::{Objective, Pruner, Sampler, Search};
pub use runner::{SearchReport, SearchSweep, search};
pub use space::{Domain, Parameter};
pub use study::{Found, Study, TUNING_SEED, found};
pub use trial::{Trial, TrialState};
