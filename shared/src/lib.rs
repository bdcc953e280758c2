//! Types and code shared by workers and learner.
//!
//! This crate does not depend on Python, an async runtime or an optimiser. It does not read clocks,
//! environment variables or global random generators; callers pass these in. `config` is stage 1 of
//! the data flow, `transport` is stages 4 and 7. `dmp` and `policy` are used by the rollout (stage
//! 3) and the update (stage 6).

pub mod checkpoint;
pub mod config;
pub mod dmp;
pub mod goal_rule;
pub mod parameters;
pub mod policy;
mod policy_description;
pub mod policy_file;
pub mod runtime;
pub mod seeds;
pub mod segment;
pub mod spec;
pub mod supervision;
pub mod transport;
