//! Measures recorded episodes.

use std::path::Path;

use anyhow::Context;

use super::file::{FORMAT, Motion};
use super::recorded::{JointKind, RecordedEpisode, RecordingReader, Robot};
use super::smoothness::{Mean, add_action_accelerations, add_action_changes, add_jerks, sparc};

/// The policy of a recording.
#[derive(Debug, Clone, Copy)]
pub struct RecordedPolicy {
    /// Version of the policy.
    pub version: u64,
    /// Environment steps on which it was trained.
    pub env_steps: u64,
    /// Seed of the first episode.
    pub first_seed: u64,
}

/// Measures the episodes in a file that an observer wrote. Reads one episode at a time, because
/// the whole file may not fit into memory.
///
/// # Errors
/// The file cannot be read, is invalid, or contains no episode.
pub fn measure(path: &Path, policy: RecordedPolicy) -> anyhow::Result<Motion> {
    let mut recorded = RecordingReader::open(path)?;
    let mut first = None;
    let mut sums = Sums::new(&recorded.robot);
    while let Some(episode) = recorded.next_episode()? {
        sums.add(&episode);
        first.get_or_insert(episode);
    }
    let mean_of = |means: &[Mean]| {
        let values: Vec<f64> = means.iter().filter_map(|mean| mean.value()).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    let mut joint_jerk_by_joint = vec![None; recorded.robot.joints.len()];
    for (joint, jerk) in sums.measured_joints.iter().zip(&sums.jerks) {
        joint_jerk_by_joint[*joint] = jerk.value();
    }
    let mut sparc = Mean::default();
    sums.arc_lengths.iter().flatten().for_each(|length| sparc.add(*length));
    Ok(Motion {
        format: FORMAT,
        policy_version: policy.version,
        env_steps: policy.env_steps,
        first_seed: policy.first_seed,
        returns: sums.returns,
        unit: sums.unit.to_owned(),
        action_change: mean_of(&sums.action_changes),
        action_change_by_dimension: sums.action_changes.iter().map(|mean| mean.value()).collect(),
        action_acceleration: mean_of(&sums.action_accelerations),
        joint_jerk: mean_of(&sums.jerks),
        joint_jerk_by_joint,
        sparc: sparc.value(),
        sparc_by_episode: sums.arc_lengths,
        robot: recorded.robot,
        episode: first.with_context(|| format!("{} contains no episode", path.display()))?,
    })
}

/// Accumulates the measures over episodes.
struct Sums {
    dt: f64,
    unit: &'static str,
    /// Indices of the measured joints.
    measured_joints: Vec<usize>,
    returns: Vec<f64>,
    action_changes: Vec<Mean>,
    action_accelerations: Vec<Mean>,
    jerks: Vec<Mean>,
    arc_lengths: Vec<Option<f64>>,
}

impl Sums {
    fn new(robot: &Robot) -> Self {
        let of_kind = |kind: JointKind| {
            let joints = robot.joints.iter().enumerate();
            joints.filter(|(_, joint)| joint.kind == kind).map(|(at, _)| at).collect::<Vec<_>>()
        };
        let hinges = of_kind(JointKind::Hinge);
        let has_hinges = !hinges.is_empty() || robot.joints.is_empty();
        let kind = if has_hinges { JointKind::Hinge } else { JointKind::Slide };
        let measured_joints = if has_hinges { hinges } else { of_kind(kind) };
        Self {
            dt: robot.control_dt_s,
            unit: kind.unit(),
            returns: Vec::new(),
            action_changes: Vec::new(),
            action_accelerations: Vec::new(),
            jerks: vec![Mean::default(); measured_joints.len()],
            arc_lengths: Vec::new(),
            measured_joints,
        }
    }

    fn add(&mut self, episode: &RecordedEpisode) {
        self.returns.push(episode.return_);
        let dims = episode.actions.first().map_or(0, Vec::len);
        for means in [&mut self.action_changes, &mut self.action_accelerations] {
            means.resize(dims.max(means.len()), Mean::default());
        }
        add_action_changes(&episode.actions, &mut self.action_changes);
        add_action_accelerations(&episode.actions, &mut self.action_accelerations);
        if self.dt <= 0.0 || self.measured_joints.is_empty() {
            self.arc_lengths.push(None);
            return;
        }
        let pick = |row: &Vec<f64>| self.measured_joints.iter().map(|&joint| row[joint]).collect();
        let velocities: Vec<Vec<f64>> = episode.joint_velocities.iter().map(pick).collect();
        add_jerks(&velocities, self.dt, &mut self.jerks);
        let norm = |row: &Vec<f64>| row.iter().map(|value| value * value).sum::<f64>().sqrt();
        let speed: Vec<f64> = velocities.iter().map(norm).collect();
        self.arc_lengths.push(sparc(&speed, 1.0 / self.dt));
    }
}
