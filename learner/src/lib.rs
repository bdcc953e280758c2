//! Stages 5 to 7 of 8 on the learner's side: replay, pacing, update, publishing, checkpoints.
//!
//! In reading order: [`start`] makes a learner, [`serve`] is its loop, [`session`] one turn of that
//! loop, [`learner`] its state, [`regime`] the difference between off-policy and on-policy
//! learning, and [`recorder`] writes its records. The learner handles only segments and policies,
//! never an environment or Python. It talks to its supervisor through `dmprl_shared::supervision`.
//! The loop is a plain loop on a plain thread.

pub mod algorithms;
pub mod checkpoint;
pub mod demonstrations;
mod error;
pub mod finite;
mod graph;
pub mod learner;
pub mod metrics;
pub mod normaliser;
pub mod off_policy;
pub mod pacing;
pub mod parameters;
pub mod recorder;
pub mod regime;
pub mod replay;
pub mod rollout_buffer;
pub mod serve;
pub mod session;
pub mod start;
pub mod update;
