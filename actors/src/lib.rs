//! Stage 3 of 8 and the first half of stage 8: rollout workers and evaluation.
//!
//! One process is one Python interpreter and E environments; one Python call runs a segment in
//! all of them. Without the feature `python` the crate is empty: a learner-only build.

#[cfg(feature = "python")]
mod acting;
#[cfg(feature = "python")]
pub mod evaluate;
#[cfg(feature = "python")]
mod exploration;
#[cfg(feature = "python")]
mod faults;
#[cfg(feature = "python")]
mod hindsight;
#[cfg(feature = "python")]
pub mod python_env;
#[cfg(feature = "python")]
pub mod recording;
#[cfg(feature = "python")]
pub mod rollout;
#[cfg(feature = "python")]
pub mod watchdog;
