//! `motion.json`: how the latest policy of a run moves.

use std::fs::File;
use std::io::{ErrorKind, Read};

use anyhow::Context;
use dmprl_run::RunDirectory;
use serde::{Deserialize, Serialize};

use super::recorded::{RecordedEpisode, Robot};

/// Maximum size of a file that is read.
const FILE_BYTES_MAX: u64 = 256 << 20;
/// Version of the file; raised when the measures or their definition change.
pub(super) const FORMAT: u32 = 1;

/// Contents of `motion.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Motion {
    /// Version of the file format.
    pub format: u32,
    /// Version of the policy.
    pub policy_version: u64,
    /// Environment steps with which the policy was trained.
    pub env_steps: u64,
    /// Episode i was reset with seed `first_seed + i`.
    pub first_seed: u64,
    /// Return of each episode.
    pub returns: Vec<f64>,
    /// The robot's joints and the duration of a step.
    pub robot: Robot,
    /// `rad` or `m`: unit of the joints that jerk and SPARC measure. Sliding joints are measured
    /// only if the robot has no hinge.
    pub unit: String,
    /// Mean |u_t - u_{t-1}| over steps and action dimensions; `None` if no episode has two steps.
    pub action_change: Option<f64>,
    /// The same for each dimension, (A,).
    pub action_change_by_dimension: Vec<Option<f64>>,
    /// Mean |jerk| over steps and joints [unit/s³]; `None` if joints or step duration are unknown.
    pub joint_jerk: Option<f64>,
    /// The same for each joint [unit/s³], (J,); `None` for a joint that is not measured.
    pub joint_jerk_by_joint: Vec<Option<f64>>,
    /// Mean over episodes of the spectral arc length of the joints' speed, which is the Euclidean
    /// norm of their velocities; `None` if no joint moves, or joints or step duration are unknown.
    pub sparc: Option<f64>,
    /// The same for each episode.
    pub sparc_by_episode: Vec<Option<f64>>,
    /// The first episode in full.
    pub episode: RecordedEpisode,
}

impl Motion {
    /// Returns the time of each row of the episode's joints \[s\], (T+1,). Row t of actions and
    /// rewards covers the time from t to t+1. If the environment does not report the duration of a
    /// step, times are in steps.
    #[must_use]
    pub fn times(&self) -> Vec<f64> {
        let dt = self.robot.control_dt_s;
        let step = if dt > 0.0 { dt } else { 1.0 };
        (0..=self.episode.rewards.len()).map(|index| index as f64 * step).collect()
    }
}

/// Reads the motion of the run's latest policy; `None` if it was not measured with the current
/// evaluation seeds.
///
/// # Errors
/// The run's files cannot be read. A damaged or older `motion.json` counts as not measured.
pub fn read(run: &RunDirectory) -> anyhow::Result<Option<Motion>> {
    let Some(row) = run.latest_row()? else { return Ok(None) };
    let settings = run.config()?.evaluation;
    let Some(motion) = stored(run)? else { return Ok(None) };
    let is_current = motion.format == FORMAT
        && motion.policy_version == row.policy_version
        && motion.first_seed == settings.first_seed
        && motion.returns.len() == settings.episodes;
    Ok(is_current.then_some(motion))
}

/// Reads the last measured motion, of any policy of the run; `None` if it is missing, damaged or
/// of an older format.
///
/// # Errors
/// The file cannot be read.
pub fn stored(run: &RunDirectory) -> anyhow::Result<Option<Motion>> {
    let path = run.motion_path();
    let file = match File::open(&path) {
        Ok(file) => file,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error).context(format!("cannot open {}", path.display())),
    };
    let mut text = Vec::new();
    let read = file.take(FILE_BYTES_MAX).read_to_end(&mut text);
    read.with_context(|| format!("cannot read {}", path.display()))?;
    Ok(serde_json::from_slice(&text).ok())
}
