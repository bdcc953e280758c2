//! Rollout workers: one process, one Python interpreter, several environments.

#[cfg(feature = "python")]
pub mod python_env;
