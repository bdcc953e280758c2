//! The file that an observer writes: one JSON object per line, first the robot, then each episode.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use dmprl_shared::policy::Primitives;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Maximum length of a line, ten times that of a humanoid's episode of 10,000 steps.
const LINE_BYTES_MAX: u64 = 256 << 20;

/// Kind of a joint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointKind {
    /// Its position is an angle \[rad\].
    Hinge,
    /// Its position is a length \[m\].
    Slide,
}

impl JointKind {
    /// Returns the unit, `rad` or `m`.
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
    /// Name in the model.
    pub name: String,
    /// Kind of the joint.
    pub kind: JointKind,
}

/// Description of the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Robot {
    /// Actuated joints; empty if the environment does not report them.
    pub joints: Vec<Joint>,
    /// Why there are no joints; empty if there are.
    pub why_no_joints: String,
    /// Appearance of the goal in rendered frames; empty if the environment does not declare it.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub goal_in_pictures: String,
    /// Duration of a step \[s\]; 0 if the environment does not report it.
    pub control_dt_s: f64,
}

/// An episode of T steps without exploration noise. Rows are points in time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedEpisode {
    /// Seed with which it was reset.
    pub seed: u64,
    /// Sum of the rewards.
    #[serde(rename = "return")]
    pub return_: f64,
    /// Whether it ended in success; null if the task does not report it.
    pub success: Option<bool>,
    /// Rewards, (T,).
    pub rewards: Vec<f64>,
    /// Actions of the policy, scaled to [-1, 1], (T, A).
    pub actions: Vec<Vec<f32>>,
    /// Positions before the first step and after each, (T+1, J) [rad or m]; empty without joints.
    pub joint_positions: Vec<Vec<f64>>,
    /// Velocities at the same times, (T+1, J) [rad/s or m/s].
    pub joint_velocities: Vec<Vec<f64>>,
    /// Whether each step reported success, (T,); empty if unknown.
    pub success_by_step: Vec<Option<bool>>,
    /// Files of rendered frames; empty if none were requested.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub frames: Vec<PathBuf>,
    /// Number of steps done before each frame.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub frame_steps: Vec<usize>,
    /// Data for a log of the episode, if it was requested.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub details: Option<EpisodeDetails>,
}

/// Observations, commands and segments of an episode of T steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeDetails {
    /// Name of each entry of an observation, (O,); empty if they have no names.
    pub observation_names: Vec<String>,
    /// Observations before the first step and after each, (T+1, O).
    pub observations: Vec<Vec<f64>>,
    /// Actions in the environment's units, (T, A).
    pub commands: Vec<Vec<f64>>,
    /// Segments in order.
    pub segments: Vec<RecordedSegment>,
}

impl EpisodeDetails {
    /// Whether these are the details of an episode of `steps` steps.
    fn has_steps(&self, steps: usize) -> bool {
        self.observations.len() == steps + 1
            && self.commands.len() == steps
            && self.segments.iter().map(|segment| segment.steps).sum::<usize>() == steps
    }
}

/// A segment: one decision of the policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedSegment {
    /// Number of steps of the episode before it.
    pub first_step: usize,
    /// Number of its steps.
    pub steps: usize,
    /// Primitives of a policy that has them.
    pub primitives: Option<Primitives>,
}

/// Reads a recording one episode at a time.
#[derive(Debug)]
pub struct RecordingReader {
    /// Description of the robot.
    pub robot: Robot,
    lines: Lines,
}

impl RecordingReader {
    /// Opens a file that an observer wrote.
    ///
    /// # Errors
    /// The file cannot be read, or does not begin with a robot's description.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        let file = File::open(path).with_context(|| format!("cannot open {}", path.display()))?;
        let mut lines = Lines { reader: BufReader::new(file), name: path.display().to_string() };
        let robot = lines.next()?.with_context(|| format!("{} is empty", lines.name))?;
        Ok(Self { robot, lines })
    }

    /// Returns the next episode; `None` after the last.
    ///
    /// # Errors
    /// The file cannot be read, or the line is not an episode of this robot.
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
                && fits(&episode.joint_velocities)
                && episode.details.as_ref().is_none_or(|details| details.has_steps(steps)),
            "{}: the episode of seed {} is inconsistent: {steps} rewards, {} actions, {} \
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

/// Parses the lines of a file.
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
        ensure!(line.ends_with(b"\n"), "{}: the last line is incomplete", self.name);
        let parsed = serde_json::from_slice(&line);
        parsed.map(Some).with_context(|| format!("{}: a line cannot be parsed", self.name))
    }
}
