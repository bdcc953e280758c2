//! Types and code that workers and learner share.
//!
//! This crate does not depend on Python, an async runtime or an optimiser. It reads no clock, no
//! environment variable and no global source of randomness: all three are passed in. `config` is
//! stage 1 of the data flow, `transport` is stages 4 and 7. Both the rollout (stage 3) and the
//! update (stage 6) use `dmp` and `policy`.

pub mod checkpoint;
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
