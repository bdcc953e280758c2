//! Synthetic results for the tests of the report.

use dmprl_shared::config::PolicyKind;
use dmprl_shared::supervision::EvaluationRow;

use super::motion_metrics::MotionMetrics;
use super::results::Results;
use super::run::{Origin, Run, Source};
use crate::motion::{Joint, JointKind, Motion, RecordedEpisode, Robot};

/// Environment steps between two evaluations.
const INTERVAL: u64 = 1_000;

/// Description of a synthetic run.
#[derive(Debug, Clone)]
pub(super) struct FixtureRun {
    pub(super) task: &'static str,
    pub(super) method: &'static str,
    pub(super) seed: u64,
    /// Return of each evaluation, or success rate on a Panda task, every 1,000 steps.
    pub(super) rows: Vec<f64>,
    pub(super) ended: bool,
}

/// Returns the results of synthetic runs.
pub(super) fn fixture_results(runs: &[FixtureRun]) -> Results {
    let mut results = Results::default();
    for run in runs {
        for (names, name) in [(&mut results.tasks, run.task), (&mut results.methods, run.method)] {
            if !names.iter().any(|known| known == name) {
                names.push(name.to_owned());
            }
        }
        let rows = run.rows.iter().zip(1..).map(|(value, index)| row(run.task, *value, index));
        results.runs.push(Run {
            task: run.task.to_owned(),
            method: run.method.to_owned(),
            policy: match run.method {
                "DDPG" | "TD3" | "SAC" => PolicyKind::Mlp,
                _ => PolicyKind::Dmp,
            },
            seed: run.seed,
            source: Source::Directory(format!("{}-{}-{}", run.task, run.method, run.seed).into()),
            ended: run.ended,
            steps: run.rows.len() as u64 * INTERVAL,
            origin: Origin {
                programs: vec!["0.1.0 (commit 0123)".to_owned()],
                packages: vec!["Python 3.11.7".to_owned()],
                ..Origin::default()
            },
            rows: rows.collect(),
            final_episodes: Some(100),
            motion: None,
        });
    }
    results
}

fn row(task: &str, value: f64, index: u64) -> EvaluationRow {
    let panda = task.starts_with("panda");
    EvaluationRow {
        env_steps: index * INTERVAL,
        updates: index * INTERVAL,
        segments: index * INTERVAL,
        wall_s: index as f64,
        policy_version: index,
        returns: vec![value],
        return_mean: value,
        success_rate: panda.then_some(value),
        smoothness: 0.1,
        at_bounds: None,
    }
}

/// Returns the metrics of [`motion_of`].
pub(super) fn fixture_motion(jerk: f64, sparc: f64) -> MotionMetrics {
    MotionMetrics::of(&motion_of(jerk, sparc))
}

/// Returns the motion of an arm with an elbow and a sliding finger over two steps.
pub(super) fn motion_of(jerk: f64, sparc: f64) -> Motion {
    let joint = |name: &str, kind| Joint { name: name.to_owned(), kind };
    Motion {
        format: 2,
        policy_version: 1,
        env_steps: INTERVAL,
        first_seed: 1_000,
        returns: vec![0.0],
        robot: Robot {
            joints: vec![joint("elbow", JointKind::Hinge), joint("finger", JointKind::Slide)],
            why_no_joints: String::new(),
            goal_in_pictures: String::new(),
            control_dt_s: 0.05,
        },
        unit: "rad".to_owned(),
        action_change: Some(0.1),
        action_change_by_dimension: vec![Some(0.1)],
        action_acceleration: Some(0.15),
        joint_jerk: Some(jerk),
        joint_jerk_by_joint: vec![Some(jerk), None],
        sparc: Some(sparc),
        sparc_by_episode: vec![Some(sparc)],
        episode: RecordedEpisode {
            seed: 1_000,
            return_: 0.0,
            success: None,
            rewards: vec![0.0; 2],
            actions: vec![vec![0.0]; 2],
            joint_positions: vec![vec![0.0, 0.0], vec![0.1, 0.0], vec![0.3, 0.0]],
            joint_velocities: vec![vec![0.0, 0.0], vec![2.0, 0.0], vec![4.0, 0.0]],
            success_by_step: Vec::new(),
            frames: Vec::new(),
            frame_steps: Vec::new(),
            details: None,
        },
    }
}
