//! Runs a trained policy on a robot, from a policy file and without Python.
//!
//! [`PolicyRuntime`] returns the actions of a segment, or one action per control step. It rejects
//! invalid observations, limits actions to their bounds and their rate to a maximum, and holds the
//! robot when observations stop, when its caller was frozen, and at the end.
//!
//! ```no_run
#![doc = include_str!("../../../docs/examples/robot/drive_robot.rs")]
//! ```
//! `dmprl.Policy` is the same runtime in NumPy (`envs_py/dmprl/policy.py`). A test compares both
//! and the ONNX graph.
//!
//! The training uses this crate by way of `dmprl-shared`: `dmp` and `policy` in the rollout (stage
//! 3 of the data flow) and the update (stage 6), `parameters` in transport (stage 7).

pub mod config;
pub mod dmp;
pub mod goal_rule;
pub mod parameters;
pub mod policy;
pub mod policy_file;
mod policy_runtime;
pub mod seeds;
pub mod segment_layout;
pub mod spec;
#[cfg(test)]
mod test_support;

pub use policy_runtime::{HOLD_STEPS_MAX, PolicyRuntime, RuntimeError, Safety};
