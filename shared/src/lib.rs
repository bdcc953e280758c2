//! What actor and learner must agree on.
//!
//! This crate knows no Python, no async runtime and no optimiser; it reads no clock, no
//! environment variable and no global source of randomness: all three are passed in.
//! `config` is stage 1 of the data flow, `transport` stages 4 and 7; `dmp` and `policy` are used
//! by both the rollout (stage 3) and the update (stage 6).

pub mod config;
pub mod dmp;
pub mod parameters;
pub mod policy;
pub mod policy_file;
pub mod runtime;
pub mod seeds;
pub mod segment;
pub mod spec;
pub mod supervision;
pub mod transport;
