//! What runs have done: motion measures, statistics, reports, plots, exported policies and
//! TensorBoard files.
//!
//! Everything here reads run directories. Nothing starts a process or draws on a terminal: the
//! caller passes a function where a policy must be rolled out.

pub mod export;
pub mod motion;
pub mod plots;
pub mod report;
pub mod tensorboard;
