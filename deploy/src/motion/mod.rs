//! Stage 8 of 8, how a policy moves: smoothness over the evaluation's episodes, and one of these in
//! full, for tables and figures.
//!
//! An observer (`roles/observer.rs`) rolls a saved policy out on the seeds of its evaluation; what
//! the robot did is measured here and kept as `motion.json` in the run, so that it is measured once
//! a policy. Only joints that actuators move count (`envs_py/dmprl/robot_joints.py`): neither a
//! pushed object nor a goal on slides.

mod recorded;
mod smoothness;

use std::fs::File;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use serde::{Deserialize, Serialize};

pub use recorded::{Joint, JointKind, Recorded, RecordedEpisode, Robot};
pub use smoothness::{Mean, add_action_changes, add_jerks, sparc};

use crate::failure::Outcome;
use crate::launch::{self, ObservationPlan};
use crate::run_directory::{PolicyChoice, RunDirectory};

/// A longer file is not one of ours.
const FILE_BYTES_MAX: u64 = 256 << 20;
/// Raised when what is measured, or how, changes.
const FORMAT: u32 = 1;

/// `motion.json`: how the run's latest policy moves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Motion {
    /// Of this file.
    pub format: u32,
    /// Version of the policy.
    pub policy_version: u64,
    /// Environment steps that it was trained with.
    pub env_steps: u64,
    /// Episode i was reset with seed `first_seed + i`.
    pub first_seed: u64,
    /// Return of each episode.
    pub returns: Vec<f64>,
    /// Its joints, and how long a step takes.
    pub robot: Robot,
    /// `rad` or `m`: of which joints jerk and SPARC are. Slides count only where nothing turns.
    pub unit: String,
    /// Mean |u_t - u_{t-1}| over steps and action dimensions; none of episodes of one step.
    pub action_change: Option<f64>,
    /// The same of each dimension, (A,).
    pub action_change_by_dimension: Vec<Option<f64>>,
    /// Mean |jerk| over steps and joints [rad/s³]; none without joints or duration of a step.
    pub joint_jerk: Option<f64>,
    /// The same of each joint [rad/s³], (J,); null of a joint that does not count.
    pub joint_jerk_by_joint: Vec<Option<f64>>,
    /// Mean over episodes of the spectral arc length of the joints' speed, the Euclidean norm of
    /// their velocities; none where nothing moves or the above is missing.
    pub sparc: Option<f64>,
    /// Of each episode.
    pub sparc_by_episode: Vec<Option<f64>>,
    /// The first episode in full.
    pub episode: RecordedEpisode,
}

impl Motion {
    /// When each row of the episode's joints is \[s\], (T+1,); row t of actions and rewards is from
    /// time t to t+1. Steps where the environment does not say how long one takes.
    #[must_use]
    pub fn times(&self) -> Vec<f64> {
        let dt = self.robot.control_dt_s;
        let step = if dt > 0.0 { dt } else { 1.0 };
        (0..=self.episode.rewards.len()).map(|index| index as f64 * step).collect()
    }
}

/// What an observer is started with.
#[derive(Debug, Clone)]
pub struct Means {
    /// The program that plays the observer: this one.
    pub program: PathBuf,
    /// The Python virtual environment.
    pub venv: PathBuf,
}

/// What is known of the run's latest policy; none if it, or another seed, was not measured.
///
/// # Errors
/// The run's files cannot be read. A damaged or older `motion.json` is as none.
pub fn read(run: &RunDirectory) -> anyhow::Result<Option<Motion>> {
    let Some(row) = run.latest_row()? else { return Ok(None) };
    let settings = run.config()?.evaluation;
    let Some(motion) = stored(run)? else { return Ok(None) };
    let fresh = motion.format == FORMAT
        && motion.policy_version == row.policy_version
        && motion.first_seed == settings.first_seed
        && motion.returns.len() == settings.episodes;
    Ok(fresh.then_some(motion))
}

/// What was measured last, of whichever policy; none if it is damaged or older.
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

/// Measures the run's latest policy over the episodes of an evaluation and keeps the result as
/// `motion.json`; what was measured already is read. None when the user interrupted it.
///
/// - `progress`: called with the number of episodes done, and of how many.
///
/// # Errors
/// Nothing was evaluated yet, the observer died, or the file system refuses.
pub fn measure(
    run: &RunDirectory,
    means: &Means,
    progress: &dyn Fn(u64, u64),
) -> anyhow::Result<Option<Motion>> {
    if let Some(motion) = read(run)? {
        return Ok(Some(motion));
    }
    let chosen = run.choose_policy(PolicyChoice::Latest)?;
    let settings = run.config()?.evaluation;
    let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
    let plan = ObservationPlan {
        program: means.program.clone(),
        run,
        venv: Some(means.venv.clone()),
        policy_version: chosen.version,
        first_seed: settings.first_seed,
        episodes: settings.episodes as u64,
        output: folder.path().join("episodes.jsonl"),
        pictures: None,
    };
    let output = plan.output.clone();
    let of = plan.episodes;
    let told = |done, steps| {
        if steps == 0 {
            progress(done, of);
        }
    };
    if launch::observe(plan, &told)? == Outcome::Interrupted {
        return Ok(None);
    }
    let env_steps = chosen.row.map_or(0, |row| row.env_steps);
    let motion = of_recorded(&output, (chosen.version, env_steps, settings.first_seed))?;
    ensure!(
        motion.returns.len() == settings.episodes,
        "{} episodes were observed, expected {}",
        motion.returns.len(),
        settings.episodes
    );
    let text = serde_json::to_string(&motion).context("cannot write motion.json")?;
    run.write_motion(&(text + "\n"))?;
    Ok(Some(motion))
}

/// Measures episodes, one after the other: of one at a time there may be much.
fn of_recorded(
    path: &Path,
    (policy_version, env_steps, first_seed): (u64, u64, u64),
) -> anyhow::Result<Motion> {
    let mut recorded = Recorded::open(path)?;
    let mut first = None;
    let mut sums = Sums::of(&recorded.robot);
    while let Some(episode) = recorded.next_episode()? {
        sums.add(&episode);
        first.get_or_insert(episode);
    }
    let mean_of = |means: &[Mean]| {
        let values: Vec<f64> = means.iter().filter_map(|mean| mean.value()).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    let mut joint_jerk_by_joint = vec![None; recorded.robot.joints.len()];
    for (joint, jerk) in sums.counted.iter().zip(&sums.jerks) {
        joint_jerk_by_joint[*joint] = jerk.value();
    }
    let mut sparc = Mean::default();
    sums.arcs.iter().flatten().for_each(|arc| sparc.add(*arc));
    Ok(Motion {
        format: FORMAT,
        policy_version,
        env_steps,
        first_seed,
        returns: sums.returns,
        unit: sums.unit.to_owned(),
        action_change: mean_of(&sums.action_changes),
        action_change_by_dimension: sums.action_changes.iter().map(|mean| mean.value()).collect(),
        joint_jerk: mean_of(&sums.jerks),
        joint_jerk_by_joint,
        sparc: sparc.value(),
        sparc_by_episode: sums.arcs,
        robot: recorded.robot,
        episode: first.with_context(|| format!("{} holds no episode", path.display()))?,
    })
}

/// What accumulates over episodes.
struct Sums {
    dt: f64,
    unit: &'static str,
    /// Joints that count.
    counted: Vec<usize>,
    returns: Vec<f64>,
    action_changes: Vec<Mean>,
    jerks: Vec<Mean>,
    arcs: Vec<Option<f64>>,
}

impl Sums {
    fn of(robot: &Robot) -> Self {
        let of_kind = |kind: JointKind| {
            let joints = robot.joints.iter().enumerate();
            joints.filter(|(_, joint)| joint.kind == kind).map(|(at, _)| at).collect::<Vec<_>>()
        };
        let hinges = of_kind(JointKind::Hinge);
        let turns = !hinges.is_empty() || robot.joints.is_empty();
        let kind = if turns { JointKind::Hinge } else { JointKind::Slide };
        let counted = if turns { hinges } else { of_kind(kind) };
        Self {
            dt: robot.control_dt_s,
            unit: kind.unit(),
            returns: Vec::new(),
            action_changes: Vec::new(),
            jerks: vec![Mean::default(); counted.len()],
            arcs: Vec::new(),
            counted,
        }
    }

    fn add(&mut self, episode: &RecordedEpisode) {
        self.returns.push(episode.return_);
        let dims = episode.actions.first().map_or(0, Vec::len);
        self.action_changes.resize(dims.max(self.action_changes.len()), Mean::default());
        add_action_changes(&episode.actions, &mut self.action_changes);
        if self.dt <= 0.0 || self.counted.is_empty() {
            self.arcs.push(None);
            return;
        }
        let pick = |row: &Vec<f64>| self.counted.iter().map(|&joint| row[joint]).collect();
        let velocities: Vec<Vec<f64>> = episode.joint_velocities.iter().map(pick).collect();
        add_jerks(&velocities, self.dt, &mut self.jerks);
        let norm = |row: &Vec<f64>| row.iter().map(|value| value * value).sum::<f64>().sqrt();
        let speed: Vec<f64> = velocities.iter().map(norm).collect();
        self.arcs.push(sparc(&speed, 1.0 / self.dt));
    }
}

#[cfg(test)]
mod tests;
