//! Types and code shared by workers and learner.
//!
//! This crate does not depend on Python, an async runtime or an optimiser. It does not read clocks,
//! environment variables or global random generators; callers pass these in. `config` is stage 1 of
//! the data flow, `transport` is stages 4 and 7. Policies, which act without the rest, are in a
//! crate of their own, [`dmprl_runtime`].

pub use dmprl_runtime::{dmp, goal_rule, parameters, policy, policy_file, seeds, spec};

pub mod checkpoint;
pub mod config;
mod policy_description;
pub mod segment;
pub mod supervision;
pub mod transport;
