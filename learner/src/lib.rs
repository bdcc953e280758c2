//! Stages 5 to 7 of 8 on the learner's side: replay, pacing, update, publishing, checkpoints.
//!
//! The learner knows no environment and no Python: it sees segments and policies. Its loop is a
//! plain loop on a plain thread.

pub mod algorithms;
pub mod checkpoint;
pub mod demonstrations;
mod graph;
pub mod learner;
pub mod metrics;
pub mod networks;
pub mod normaliser;
pub mod pacing;
pub mod replay;
pub mod rollout_buffer;
pub mod session;
pub mod update;
