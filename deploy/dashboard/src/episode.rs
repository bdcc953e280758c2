//! Reads one episode of a run's policy, joint by joint, from `motion.json`.

use dmprl_analysis::motion::{self, Motion};
use dmprl_run::RunDirectory;
use serde_json::{Value, json};

use super::table::rounded;

/// Maximum number of rows in a response; longer episodes are thinned out.
const ROWS_MAX: usize = 1_000;

/// Returns the data of the charts; null if the run's motion has not been recorded.
///
/// # Errors
/// The file cannot be read.
pub fn read(run: &RunDirectory) -> anyhow::Result<Value> {
    Ok(motion::read_any(run)?.map_or(Value::Null, |motion| chart_data(&motion)))
}

fn chart_data(motion: &Motion) -> Value {
    let Motion { episode, robot, .. } = motion;
    let times = motion.times();
    let every = times.len().div_ceil(ROWS_MAX).max(1);
    let is_kept = |row: usize| row.is_multiple_of(every);
    let by_joint = |rows: &[Vec<f64>]| -> Vec<Vec<f64>> {
        let column = |joint: usize| {
            let chosen = rows.iter().enumerate().filter(|(row, _)| is_kept(*row));
            chosen.map(|(_, values)| rounded(values[joint])).collect()
        };
        (0..rows.first().map_or(0, Vec::len)).map(column).collect()
    };
    let actions: Vec<Vec<f64>> = episode
        .actions
        .iter()
        .map(|action| action.iter().copied().map(f64::from).collect())
        .collect();
    let joints = robot.joints.iter();
    json!({
        "policy_version": motion.policy_version,
        "env_steps": motion.env_steps,
        "seed": episode.seed,
        "return": rounded(episode.return_),
        "success": episode.success,
        "action_change": motion.action_change.map(rounded),
        "joint_jerk": motion.joint_jerk.map(rounded),
        "sparc": motion.sparc.map(rounded),
        "unit": motion.unit,
        "in_seconds": robot.control_dt_s > 0.0,
        "times": times.iter().enumerate().filter(|(row, _)| is_kept(*row))
            .map(|(_, time)| rounded(*time)).collect::<Vec<_>>(),
        "joints": joints.map(|joint| json!({"name": joint.name, "unit": joint.kind.unit()}))
            .collect::<Vec<_>>(),
        "why_no_joints": robot.why_no_joints,
        "positions": by_joint(&episode.joint_positions),
        "velocities": by_joint(&episode.joint_velocities),
        "actions": by_joint(&actions),
    })
}
