//! Stage 8 of 8: measures how smoothly a policy moves.
//!
//! `dmprl_sweep::record` starts an observer process, which rolls out a saved policy with the seeds
//! of its evaluation and writes the episodes to a file. `recorded` reads them, and `measure`
//! computes jerk, spectral arc length and change of actions. The results are kept in `motion.json`
//! in the run directory (`file`), so each policy is measured only once. Only actuated joints are
//! measured (`envs_py/dmprl/robot_joints.py`), not those of pushed objects or goals.

mod file;
mod measure;
mod recorded;
mod smoothness;
#[cfg(test)]
mod tests;

pub use file::{Motion, read, read_any};
pub use measure::{RecordedPolicy, measure};
pub use recorded::{
    EpisodeDetails, Joint, JointKind, RecordedEpisode, RecordedSegment, RecordingReader, Robot,
};
