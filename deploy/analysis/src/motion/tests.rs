//! Tests the measures with recordings whose jerk and change of actions are known.

use std::path::{Path, PathBuf};

use super::*;

const POLICY: RecordedPolicy = RecordedPolicy { version: 3, env_steps: 500, first_seed: 7 };

fn joint(name: &str, kind: JointKind) -> Joint {
    Joint { name: name.to_owned(), kind }
}

/// Writes a recording with episodes of the given lengths; returns its path.
///
/// The velocity of hinges is half the square of the step, so their jerk is 1 / dt². The velocities
/// of slides differ, so a measure that included them would be noticed.
fn write_recording(folder: &Path, robot: &Robot, lengths: &[usize]) -> PathBuf {
    let mut lines = vec![serde_json::to_string(robot).unwrap()];
    for (index, &steps) in lengths.iter().enumerate() {
        let row = |step: usize| {
            let joints = robot.joints.iter().map(|joint| match joint.kind {
                JointKind::Hinge => (step * step) as f64 / 2.0,
                JointKind::Slide => 1_000.0 * (step % 2) as f64,
            });
            joints.collect::<Vec<_>>()
        };
        let rows = if robot.joints.is_empty() { 0 } else { steps + 1 };
        let episode = RecordedEpisode {
            seed: 7 + index as u64,
            return_: -(steps as f64),
            success: None,
            rewards: vec![-1.0; steps],
            actions: (0..steps).map(|step| vec![(step % 2) as f32, 0.0]).collect(),
            joint_positions: (0..rows).map(row).collect(),
            joint_velocities: (0..rows).map(row).collect(),
            success_by_step: Vec::new(),
            frames: Vec::new(),
            frame_steps: Vec::new(),
            details: None,
        };
        lines.push(serde_json::to_string(&episode).unwrap());
    }
    let path = folder.join("episodes.jsonl");
    std::fs::write(&path, lines.join("\n") + "\n").unwrap();
    path
}

#[test]
fn all_episodes_are_measured_and_the_first_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let joints = vec![joint("rail", JointKind::Slide), joint("elbow", JointKind::Hinge)];
    let robot = Robot {
        joints,
        why_no_joints: String::new(),
        goal_in_pictures: String::new(),
        control_dt_s: 0.1,
    };
    let motion = measure(&write_recording(folder.path(), &robot, &[20, 30]), POLICY).unwrap();
    assert_eq!(motion.returns, [-20.0, -30.0]);
    assert_eq!((motion.episode.seed, motion.times().len()), (7, 21));
    assert_eq!(motion.action_change_by_dimension, [Some(1.0), Some(0.0)]);
    assert_eq!(motion.action_change, Some(0.5));
    // 0, 1, 0 in one dimension, and 0 in the other.
    assert_eq!(motion.action_acceleration, Some(1.0));
    assert_eq!(motion.unit, "rad");
    assert_eq!(motion.joint_jerk_by_joint[0], None);
    assert!((motion.joint_jerk.unwrap() - 100.0).abs() < 1e-6, "{:?}", motion.joint_jerk);
    assert!(motion.sparc_by_episode.iter().all(Option::is_some));
    let json = serde_json::to_string(&motion).unwrap();
    assert_eq!(serde_json::from_str::<Motion>(&json).unwrap(), motion);
}

#[test]
fn robot_with_sliding_joints_only_is_measured_in_metres() {
    let folder = tempfile::tempdir().unwrap();
    let joints = vec![joint("rail", JointKind::Slide)];
    let robot = Robot {
        joints,
        why_no_joints: String::new(),
        goal_in_pictures: String::new(),
        control_dt_s: 0.1,
    };
    let motion = measure(&write_recording(folder.path(), &robot, &[20]), POLICY).unwrap();
    assert_eq!(motion.unit, "m");
    assert!((motion.joint_jerk.unwrap() - 200_000.0).abs() < 1e-3, "{:?}", motion.joint_jerk);
}

#[test]
fn without_joints_only_actions_are_measured() {
    let folder = tempfile::tempdir().unwrap();
    let why_no_joints = "not reported".to_owned();
    let robot = Robot {
        joints: Vec::new(),
        why_no_joints,
        goal_in_pictures: String::new(),
        control_dt_s: 0.0,
    };
    let motion = measure(&write_recording(folder.path(), &robot, &[5]), POLICY).unwrap();
    assert_eq!((motion.joint_jerk, motion.sparc, motion.action_change), (None, None, Some(0.5)));
    assert_eq!(motion.times(), [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
}

#[test]
fn inconsistent_or_incomplete_episode_is_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let robot = |joints| Robot {
        joints,
        why_no_joints: String::new(),
        goal_in_pictures: String::new(),
        control_dt_s: 0.1,
    };
    let path = write_recording(folder.path(), &robot(Vec::new()), &[4]);
    let text = std::fs::read_to_string(&path).unwrap();
    let (_, episode) = text.split_once('\n').unwrap();
    let head = serde_json::to_string(&robot(vec![joint("elbow", JointKind::Hinge)])).unwrap();
    std::fs::write(&path, format!("{head}\n{episode}")).unwrap();
    let error = measure(&path, POLICY).unwrap_err().to_string();
    assert!(error.contains("0 positions, 0 velocities of 1 joints"), "{error}");
    std::fs::write(&path, text.trim_end()).unwrap();
    assert!(measure(&path, POLICY).unwrap_err().to_string().contains("incomplete"));
}
