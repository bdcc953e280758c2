//! The part of `motion.json` that a report shows: three figures and one rollout. It is small enough
//! for `report-data.json`.

use anyhow::ensure;
use serde::{Deserialize, Serialize};

use crate::motion::Motion;

/// Positions and velocities are rounded to four decimals, which is finer than a pixel of a plot.
const ROUNDING: f64 = 1e4;

/// Motion of a run's latest policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionMetrics {
    /// Mean absolute second difference of the actions; absent in reports of older programs.
    #[serde(default)]
    pub action_acceleration: Option<f64>,
    /// Mean |jerk| over steps and joints [rad/s³; m/s³ for a robot without hinges].
    pub joint_jerk: Option<f64>,
    /// Spectral arc length of the joints' speed.
    pub sparc: Option<f64>,
    /// The first episode; `None` if the joints are unknown, or the run was read from an earlier
    /// report that does not show it.
    pub rollout: Option<Rollout>,
}

/// Joint positions and velocities of an episode of T steps. All joints have the same unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rollout {
    /// Seed of the episode.
    pub seed: u64,
    /// Duration of a step \[s\]; 0 if the environment does not report it.
    pub control_dt_s: f64,
    /// `rad` or `m`.
    pub unit: String,
    /// Names of the joints, (J,).
    pub joints: Vec<String>,
    /// Positions, (T+1, J) [unit].
    pub positions: Vec<Vec<f64>>,
    /// Velocities, (T+1, J) [unit/s].
    pub velocities: Vec<Vec<f64>>,
}

impl MotionMetrics {
    /// Selects the data that a report shows.
    #[must_use]
    pub fn of(motion: &Motion) -> Self {
        let Motion { action_acceleration, joint_jerk, sparc, .. } = *motion;
        Self { action_acceleration, joint_jerk, sparc, rollout: Rollout::of(motion) }
    }
}

impl Rollout {
    /// Returns the rollout of a motion; `None` without joints. The values are rounded here, so that
    /// pictures drawn from a motion and from an earlier report are the same.
    fn of(motion: &Motion) -> Option<Self> {
        let joints = motion.robot.joints.iter().enumerate();
        let counted: Vec<usize> = joints
            .filter(|(_, joint)| joint.kind.unit() == motion.unit)
            .map(|(index, _)| index)
            .collect();
        let rounded = |value: f64| (value * ROUNDING).round() / ROUNDING;
        let pick = |rows: &[Vec<f64>]| -> Vec<Vec<f64>> {
            let row = |row: &Vec<f64>| counted.iter().map(|&joint| rounded(row[joint])).collect();
            rows.iter().map(row).collect()
        };
        (!counted.is_empty()).then(|| Self {
            seed: motion.first_seed,
            control_dt_s: motion.robot.control_dt_s,
            unit: motion.unit.clone(),
            joints: counted.iter().map(|&at| motion.robot.joints[at].name.clone()).collect(),
            positions: pick(&motion.episode.joint_positions),
            velocities: pick(&motion.episode.joint_velocities),
        })
    }

    /// Returns the time of each row \[s\], (T+1,). Times are in steps if the duration of a step is
    /// unknown.
    #[must_use]
    pub fn times(&self) -> Vec<f64> {
        let step = if self.control_dt_s > 0.0 { self.control_dt_s } else { 1.0 };
        (0..self.positions.len()).map(|index| index as f64 * step).collect()
    }

    /// Returns true if the other rollout has the same episode and robot, so that both can be
    /// compared in a figure.
    #[must_use]
    pub fn is_comparable(&self, other: &Self) -> bool {
        (self.seed, self.control_dt_s, &self.unit, &self.joints)
            == (other.seed, other.control_dt_s, &other.unit, &other.joints)
    }

    /// Checks the lengths of all rows.
    ///
    /// # Errors
    /// The lengths do not match, or there are no joints or rows.
    pub fn check(&self) -> anyhow::Result<()> {
        let (joints, rows) = (self.joints.len(), self.positions.len());
        let fit = |rows: &[Vec<f64>]| rows.iter().all(|row| row.len() == joints);
        ensure!(
            joints > 0 && rows > 0 && self.velocities.len() == rows,
            "the rollout has {joints} joints, {rows} rows of positions and {} of velocities; \
             expected at least one joint and row, and equal numbers of rows",
            self.velocities.len()
        );
        ensure!(
            fit(&self.positions) && fit(&self.velocities),
            "the rollout has rows whose length differs from its {joints} joints"
        );
        Ok(())
    }
}
