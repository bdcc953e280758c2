//! Stages 5 to 7 of 8 on the learner's side: replay, pacing, update, publishing, checkpoints.
//!
//! A learner's life, in reading order: [`start`] makes it, [`serve`] is its loop, [`session`] one
//! turn of that loop, [`learner`] the state behind it, [`recorder`] what it records. It knows no
//! environment and no Python: it sees segments and policies, and knows its supervisor by
//! `dmprl_shared::supervision` only. The loop is a plain loop on a plain thread.

pub mod algorithms;
pub mod checkpoint;
pub mod demonstrations;
mod graph;
pub mod learner;
pub mod metrics;
pub mod networks;
pub mod normaliser;
pub mod pacing;
pub mod recorder;
pub mod replay;
pub mod rollout_buffer;
pub mod serve;
pub mod session;
pub mod start;
pub mod update;
