//! The `dmprl` program: its commands, the roles of its processes, and what it shows on a terminal.
//!
//! One binary plays every part: `dmprl train` starts itself again as `dmprl learner`, `dmprl actor`
//! and `dmprl evaluator`, and exchanges the lines of `dmprl-control` with them.

pub mod cli;
mod doctor;
pub mod roles;
pub mod terminal;
