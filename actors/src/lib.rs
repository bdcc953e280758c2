//! Stage 3 of 8 and the first half of stage 8: rollout workers and evaluation.
//!
//! A worker is one process with one Python interpreter and E environments. Its life, in reading
//! order: [`environments`] makes them, [`worker`] is the loop, [`rollout`] runs a segment in all of
//! them with one Python call, [`delivery`] gets the segments to the learner. [`evaluator`] is the
//! evaluator's loop and [`evaluate`] its episodes. Neither knows the learner; both know their
//! supervisor by `dmprl_shared::supervision` only.
//!
//! Without the feature `python` only [`delivery`] is built: a learner-only build.

pub mod delivery;
#[cfg(feature = "python")]
pub mod environments;
#[cfg(feature = "python")]
pub mod evaluate;
#[cfg(feature = "python")]
pub mod evaluator;
#[cfg(feature = "python")]
mod exploration;
#[cfg(feature = "python")]
mod faults;
#[cfg(feature = "python")]
mod hindsight;
#[cfg(feature = "python")]
mod policy_runner;
#[cfg(feature = "python")]
pub mod python_env;
#[cfg(feature = "python")]
pub mod recording;
#[cfg(feature = "python")]
pub mod rollout;
#[cfg(feature = "python")]
pub mod watchdog;
#[cfg(feature = "python")]
pub mod worker;
