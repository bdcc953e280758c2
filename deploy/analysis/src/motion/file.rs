//! Reads `motion.json`, the measured motion of a run's latest policy.

use std::fs::File;
use std::io::{ErrorKind, Read};

use anyhow::Context;
use dmprl_run::RunDirectory;
use serde::{Deserialize, Serialize};

use super::recorded::{RecordedEpisode, Robot};

/// Maximum number of bytes read.
const FILE_BYTES_MAX: u64 = 256 << 20;
/// Version of the format; raised when the measures or their definitions change.
pub(super) const FORMAT: u32 = 2;

/// Contents of `motion.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Motion {
    /// Version of the file format.
    pub format: u32,
    /// Version of the policy.
    pub policy_version: u64,
    /// Environment steps on which the policy was trained.
    pub env_steps: u64,
    /// Episode i was reset with seed `first_seed + i`.
    pub first_seed: u64,
    /// Return of each episode.
    pub returns: Vec<f64>,
    /// Joints of the robot, and duration of a step.
    pub robot: Robot,
    /// Unit of the measured joints, `rad` or `m`. Jerk and SPARC measure the hinges, or the sliding
    /// joints if there is no hinge.
    pub unit: String,
    /// Mean |u_t - u_{t-1}| over steps and action dimensions; `None` if no episode has two steps.
    pub action_change: Option<f64>,
    /// The same by dimension, (A,).
    pub action_change_by_dimension: Vec<Option<f64>>,
    /// Mean |u_t - 2 u_{t-1} + u_{t-2}| over steps and action dimensions; `None` if no episode has
    /// three steps.
    pub action_acceleration: Option<f64>,
    /// Mean |jerk| over steps and joints [unit/s³]; `None` if joints or step duration are unknown.
    pub joint_jerk: Option<f64>,
    /// The same by joint [unit/s³], (J,); `None` for joints that are not measured.
    pub joint_jerk_by_joint: Vec<Option<f64>>,
    /// Spectral arc length of the joints' speed, averaged over episodes; `None` if no joint moves,
    /// or joints or step duration are unknown. The speed is the Euclidean norm of the velocities.
    pub sparc: Option<f64>,
    /// The same by episode.
    pub sparc_by_episode: Vec<Option<f64>>,
    /// Complete data of the first episode.
    pub episode: RecordedEpisode,
}

impl Motion {
    /// Returns the time of each row of joint positions \[s\], (T+1,). Row t of actions and rewards
    /// covers the interval from time t to t+1. Times are in steps if the environment does not
    /// report the duration of a step.
    #[must_use]
    pub fn times(&self) -> Vec<f64> {
        let dt = self.robot.control_dt_s;
        let step = if dt > 0.0 { dt } else { 1.0 };
        (0..=self.episode.rewards.len()).map(|index| index as f64 * step).collect()
    }
}

/// Reads the motion of the run's latest policy; `None` if it has not been measured with the current
/// evaluation seeds.
///
/// # Errors
/// The run's files cannot be read. An invalid or older `motion.json` counts as not measured.
pub fn read(run: &RunDirectory) -> anyhow::Result<Option<Motion>> {
    let Some(row) = run.latest_row()? else { return Ok(None) };
    let settings = run.config()?.evaluation;
    let Some(motion) = read_any(run)? else { return Ok(None) };
    let is_current = motion.format == FORMAT
        && motion.policy_version == row.policy_version
        && motion.first_seed == settings.first_seed
        && motion.returns.len() == settings.episodes;
    Ok(is_current.then_some(motion))
}

/// Reads the last measured motion, of any policy of the run; `None` if the file is missing or
/// cannot be parsed.
///
/// # Errors
/// The file cannot be read.
pub fn read_any(run: &RunDirectory) -> anyhow::Result<Option<Motion>> {
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
