//! The `dmprl` program: commands, the supervisor of a run, the roles it starts, the run directory.
//!
//! Stage 2 of 8 (`launch`) and what a user sees of stage 8 (`terminal`, `plots`, `cli`). One
//! binary plays every part: `dmprl train` starts itself again as `dmprl learner`, `dmprl actor`
//! and `dmprl evaluator` and speaks with them in the lines that `control` defines.

mod answer;
pub mod bench;
pub mod bridge;
mod capacity;
pub mod chaos;
pub mod cli;
pub mod control;
mod dashboard;
mod doctor;
pub mod export;
pub mod failure;
pub mod journal;
pub mod launch;
pub mod motion;
pub mod plots;
pub mod project;
#[cfg(feature = "python")]
pub mod python_setup;
pub mod record;
pub mod report;
pub mod roles;
pub mod run_directory;
pub mod sweep;
pub mod tensorboard;
pub mod terminal;
