//! How a run moves, as far as a report shows it: what is left of a `motion.json` where only figures
//! and one rollout are looked at, small enough to stay in `curves.json`.

use anyhow::ensure;
use serde::{Deserialize, Serialize};

use crate::motion::Motion;

/// Decimals of a joint's position and velocity: less than a point of a picture.
const DECIMALS: f64 = 1e4;

/// Of a run's last policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Moves {
    /// Mean |jerk| over steps and joints [rad/s³, or m/s³ where nothing turns].
    pub joint_jerk: Option<f64>,
    /// Spectral arc length of the joints' speed.
    pub sparc: Option<f64>,
    /// Its first episode, where the joints are known and the picture of it is at hand.
    pub rollout: Option<Rollout>,
}

/// The joints over one episode of T steps; those that are measured in the same unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rollout {
    /// What the episode was reset with.
    pub seed: u64,
    /// Duration of a step \[s\]; 0 if the environment does not say.
    pub control_dt_s: f64,
    /// `rad` or `m`.
    pub unit: String,
    /// Their names, (J,).
    pub joints: Vec<String>,
    /// (T+1, J) [unit].
    pub positions: Vec<Vec<f64>>,
    /// (T+1, J) [unit/s].
    pub velocities: Vec<Vec<f64>>,
}

impl Moves {
    /// What a report shows of a motion.
    #[must_use]
    pub fn of(motion: &Motion) -> Self {
        let Motion { joint_jerk, sparc, .. } = *motion;
        Self { joint_jerk, sparc, rollout: Rollout::of(motion) }
    }
}

impl Rollout {
    /// Rounded here and not where it is written, so that a picture does not change when its run is
    /// landed. None without joints.
    fn of(motion: &Motion) -> Option<Self> {
        let joints = motion.robot.joints.iter().enumerate();
        let counted: Vec<usize> = joints
            .filter(|(_, joint)| joint.kind.unit() == motion.unit)
            .map(|(index, _)| index)
            .collect();
        let rounded = |value: f64| (value * DECIMALS).round() / DECIMALS;
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

    /// When each row is \[s\], (T+1,); steps where the environment does not say how long one takes.
    #[must_use]
    pub fn times(&self) -> Vec<f64> {
        let step = if self.control_dt_s > 0.0 { self.control_dt_s } else { 1.0 };
        (0..self.positions.len()).map(|index| index as f64 * step).collect()
    }

    /// Whether the same episode of the same robot is shown: only then are two panels comparable.
    #[must_use]
    pub fn is_beside(&self, other: &Self) -> bool {
        (self.seed, self.control_dt_s, &self.unit, &self.joints)
            == (other.seed, other.control_dt_s, &other.unit, &other.joints)
    }

    /// # Errors
    /// It does not fit together.
    pub fn check(&self) -> anyhow::Result<()> {
        let (joints, rows) = (self.joints.len(), self.positions.len());
        let fit = |rows: &[Vec<f64>]| rows.iter().all(|row| row.len() == joints);
        ensure!(
            joints > 0 && rows > 0 && self.velocities.len() == rows,
            "the rollout has {joints} joints, {rows} rows of positions and {} of velocities: \
             expected at least one, and as many of both",
            self.velocities.len()
        );
        ensure!(
            fit(&self.positions) && fit(&self.velocities),
            "the rollout has rows that are not of its {joints} joints"
        );
        Ok(())
    }
}
