//! What the observer writes for whoever has it observe: one JSON object a line, the robot first,
//! then an episode each.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// A longer line is no episode: 10,000 steps of a humanoid take a tenth.
const LINE_BYTES_MAX: u64 = 256 << 20;

/// Of what a joint's position is a measure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointKind {
    /// An angle \[rad\].
    Hinge,
    /// A length \[m\].
    Slide,
}

impl JointKind {
    /// `rad` or `m`.
    #[must_use]
    pub fn unit(self) -> &'static str {
        match self {
            Self::Hinge => "rad",
            Self::Slide => "m",
        }
    }
}

/// A joint of the robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Joint {
    /// Its name in the model.
    pub name: String,
    /// What it measures.
    pub kind: JointKind,
}

/// Whose episodes these are.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Robot {
    /// Those that actuators move; none if the environment does not show them.
    pub joints: Vec<Joint>,
    /// Why there are none; empty if there are some.
    pub why_no_joints: String,
    /// What the goal looks like in a picture; empty if nobody knows.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub goal_in_pictures: String,
    /// Duration of a step \[s\]; 0 if the environment does not say.
    pub control_dt_s: f64,
}

/// One noise-free episode of T steps. Rows are time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedEpisode {
    /// What it was reset with.
    pub seed: u64,
    /// Sum of its rewards.
    #[serde(rename = "return")]
    pub return_: f64,
    /// Whether it ended in success; none where the task does not say.
    pub success: Option<bool>,
    /// (T,).
    pub rewards: Vec<f64>,
    /// The policy's actions in [-1, 1], (T, A).
    pub actions: Vec<Vec<f32>>,
    /// (T+1, J) [rad or m]: before the first step, and after each; empty without joints.
    pub joint_positions: Vec<Vec<f64>>,
    /// (T+1, J) [rad/s or m/s].
    pub joint_velocities: Vec<Vec<f64>>,
    /// (T,): whether each step reported success; empty where that is not known.
    pub success_by_step: Vec<Option<bool>>,
    /// Files of pictures, if they were asked for,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub frames: Vec<PathBuf>,
    /// and the number of steps done at each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub frame_steps: Vec<usize>,
}

/// Episodes, read one at a time.
#[derive(Debug)]
pub struct Recorded {
    /// Whose they are.
    pub robot: Robot,
    lines: Lines,
}

impl Recorded {
    /// Opens what an observer wrote.
    ///
    /// # Errors
    /// The file cannot be read, or does not begin with a robot.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        let file = File::open(path).with_context(|| format!("cannot open {}", path.display()))?;
        let mut lines = Lines { reader: BufReader::new(file), name: path.display().to_string() };
        let robot = lines.next()?.with_context(|| format!("{} is empty", lines.name))?;
        Ok(Self { robot, lines })
    }

    /// The next episode; none after the last.
    ///
    /// # Errors
    /// The file cannot be read, or the line is no episode of this robot.
    pub fn next_episode(&mut self) -> anyhow::Result<Option<RecordedEpisode>> {
        let Some(episode) = self.lines.next::<RecordedEpisode>()? else { return Ok(None) };
        let (steps, joints) = (episode.rewards.len(), self.robot.joints.len());
        let fits = |rows: &[Vec<f64>]| {
            (rows.is_empty() && joints == 0)
                || (rows.len() == steps + 1 && rows.iter().all(|row| row.len() == joints))
        };
        ensure!(
            episode.actions.len() == steps
                && episode.frames.len() == episode.frame_steps.len()
                && episode.frame_steps.iter().all(|&step| step <= steps)
                && fits(&episode.joint_positions)
                && fits(&episode.joint_velocities),
            "{}: the episode of seed {} does not fit together: {steps} rewards, {} actions, {} \
             positions, {} velocities of {joints} joints",
            self.lines.name,
            episode.seed,
            episode.actions.len(),
            episode.joint_positions.len(),
            episode.joint_velocities.len(),
        );
        Ok(Some(episode))
    }
}

#[derive(Debug)]
struct Lines {
    reader: BufReader<File>,
    name: String,
}

impl Lines {
    fn next<T: DeserializeOwned>(&mut self) -> anyhow::Result<Option<T>> {
        let mut line = Vec::new();
        let read = (&mut self.reader).take(LINE_BYTES_MAX).read_until(b'\n', &mut line);
        if read.with_context(|| format!("cannot read {}", self.name))? == 0 {
            return Ok(None);
        }
        ensure!(line.ends_with(b"\n"), "{}: a line is not whole", self.name);
        let parsed = serde_json::from_slice(&line);
        parsed.map(Some).with_context(|| format!("{}: a line is no episode", self.name))
    }
}
