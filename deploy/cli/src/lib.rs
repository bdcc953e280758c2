//! The `dmprl` program: its commands, the roles of its processes, and its terminal output.
//!
//! All processes of a run are this program: `dmprl train` starts `dmprl learner`, `dmprl actor` and
//! `dmprl evaluator`, and exchanges JSON lines with them as defined in `dmprl-control`.

pub mod cli;
mod doctor;
pub mod roles;
pub mod terminal;
