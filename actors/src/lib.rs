//! Stage 3 of 8 and the first half of stage 8: rollout workers and evaluation.
//!
//! A worker is a process with one Python interpreter and E environments. In reading order:
//! [`environments`] creates the environments, [`worker`] is the loop, [`rollout`] runs a segment in
//! all environments with one Python call, [`delivery`] sends the segments to the learner.
//! [`evaluator`] is the evaluator's loop and [`evaluate`] runs its episodes. Worker and evaluator
//! communicate with their supervisor only through `dmprl_shared::supervision`, and do not use the
//! learner's code.
//!
//! A build without the feature `python`, for a learner only, contains only [`delivery`].

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
mod goal_switching;
#[cfg(feature = "python")]
mod hindsight;
#[cfg(feature = "python")]
mod hindsight_note;
#[cfg(feature = "python")]
pub mod policy_health;
#[cfg(feature = "python")]
mod policy_runner;
#[cfg(feature = "python")]
pub mod python_env;
#[cfg(feature = "python")]
pub mod recording;
#[cfg(feature = "python")]
pub mod rollout;
#[cfg(feature = "python")]
pub mod trace;
#[cfg(feature = "python")]
pub mod watchdog;
#[cfg(feature = "python")]
pub mod worker;
