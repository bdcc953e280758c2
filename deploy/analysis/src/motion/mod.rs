//! Stage 8 of 8: measures how smoothly a policy moves.
//!
//! An observer process, which `dmprl_sweep::record` starts, rolls a saved policy out with the seeds
//! of its evaluation and writes the episodes, which `recorded` reads. `measure` computes jerk,
//! spectral arc length and change of actions; `file` keeps them in `motion.json` in the run
//! directory, so each policy is measured once. Only joints that actuators move are measured
//! (`envs_py/dmprl/robot_joints.py`), not a pushed object or a goal on slides.

mod file;
mod measure;
mod recorded;
mod smoothness;
#[cfg(test)]
mod tests;

pub use file::{Motion, read, stored};
pub use measure::{RecordedPolicy, measure};
pub use recorded::{Joint, JointKind, Recorded, RecordedEpisode, Robot};
