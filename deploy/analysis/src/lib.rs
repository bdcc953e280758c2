//! Analysis of runs: motion measures, statistics, reports, plots, exported policies and
//! TensorBoard files.
//!
//! The crate reads run directories. It starts no process and does not write to the terminal: where
//! a policy must be rolled out, the caller passes a function.

pub mod export;
pub mod motion;
pub mod plots;
pub mod publication;
pub mod report;
pub mod tensorboard;
