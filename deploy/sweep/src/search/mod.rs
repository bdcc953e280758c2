//! `[search]`: Optuna suggests values of configuration keys, trial by trial.
//!
//! ```text
//!  runner ── ask ──► dmprl.search (Optuna) ─► values ─► a trial: dmprl train, seed after seed
//!    │  ◄── prune? ──┘     │                                │
//!    └── report, tell ─────┘ ◄────── evaluations.jsonl ─────┘
//! ```
//! Optuna's storage, `optuna.db`, is authoritative for trials and their results: a restarted search
//! continues the trials that the storage lists as running, from the checkpoints of their runs.
//! `trial.json` in each trial's folder has the same data for listings and reports, which work
//! without Python. The runs of a trial are trained one seed after the other, so that a bad trial
//! can be pruned before all of them have run.

mod endings;
mod optuna;
mod remaining;
mod runner;

pub use runner::{SearchReport, SearchSweep, search};
