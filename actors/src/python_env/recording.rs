//! One environment that writes down what its robot does (`envs_py/dmprl/recording.py`).

use std::path::Path;

use pyo3::prelude::*;

use super::{Interpreter, PythonEnvironments, PythonError};

/// What a joint's position is a measure of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JointKind {
    /// An angle \[rad\].
    Hinge,
    /// A length \[m\].
    Slide,
}

/// The robot's joints; of an environment that does not show them there are none.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Joints {
    /// Name and kind of each.
    pub joints: Vec<(String, JointKind)>,
    /// Why there are none; empty if there are some.
    pub why_none: String,
}

/// What the Python side wrote down of an episode of T steps.
#[derive(Debug, Clone, PartialEq)]
pub struct StepRecording {
    /// (T+1, J) [rad or m]: before the first step, and after each; empty without joints.
    pub joint_positions: Vec<Vec<f64>>,
    /// (T+1, J) [rad/s or m/s].
    pub joint_velocities: Vec<Vec<f64>>,
    /// (T,): after each step, as [`PythonEnvironments::success`]; empty if only a segment's is
    /// known.
    pub success: Vec<u8>,
    /// Files of pictures, if they were asked for,
    pub frames: Vec<String>,
    /// and the number of steps done at each.
    pub frame_steps: Vec<usize>,
}

impl PythonEnvironments {
    /// Makes one environment of `task_id` whose steps are written down, and drawn into a folder.
    ///
    /// # Errors
    /// As [`PythonEnvironments::start`]; `Exception` if nothing can draw it.
    pub fn start_recording(
        _interpreter: &Interpreter,
        task_id: &str,
        segment_steps: usize,
        pictures: Option<&Path>,
    ) -> Result<Self, PythonError> {
        Self::start_with(1, segment_steps, |py| {
            let module = py.import("dmprl.recording")?;
            module.getattr("make")?.call1((task_id, segment_steps, pictures))
        })
    }

    /// What the goal looks like in a picture; empty if nobody knows.
    ///
    /// # Errors
    /// `Exception` when the installed package does not fit.
    pub fn goal_in_pictures(&self) -> Result<String, PythonError> {
        self.ask(|env| env.call_method0("goal_in_pictures")?.extract())
    }

    /// The robot's joints; only of [`PythonEnvironments::start_recording`].
    ///
    /// # Errors
    /// `Exception` or `Interface` when the installed package does not fit.
    pub fn joints(&self) -> Result<Joints, PythonError> {
        let read = |env: &Bound<'_, PyAny>| -> PyResult<_> {
            let joints: Vec<(String, String)> = env.call_method0("joints")?.extract()?;
            Ok((joints, env.call_method0("why_no_joints")?.extract()?))
        };
        let (named, why_none) = self.ask(read)?;
        let mut joints = Vec::with_capacity(named.len());
        for (name, kind) in named {
            let kind = match kind.as_str() {
                "hinge" => JointKind::Hinge,
                "slide" => JointKind::Slide,
                other => return Err(self.unfit(format!("joint {name} is a {other}"))),
            };
            joints.push((name, kind));
        }
        Ok(Joints { joints, why_none })
    }

    /// What was written down since the last reset by a seed.
    ///
    /// # Errors
    /// `Exception` or `Interface` when the installed package does not fit.
    pub fn recording(&self, steps: usize) -> Result<StepRecording, PythonError> {
        let recording = self.ask(|env| -> PyResult<_> {
            let recording = env.call_method0("recording")?;
            Ok(StepRecording {
                joint_positions: recording.get_item("joint_positions")?.extract()?,
                joint_velocities: recording.get_item("joint_velocities")?.extract()?,
                success: recording.get_item("success")?.extract()?,
                frames: recording.get_item("frames")?.extract()?,
                frame_steps: recording.get_item("frame_steps")?.extract()?,
            })
        })?;
        let fits = |rows: usize, expected: usize| rows == 0 || rows == expected;
        let (positions, velocities) =
            (recording.joint_positions.len(), recording.joint_velocities.len());
        if fits(positions, steps + 1)
            && velocities == positions
            && fits(recording.success.len(), steps)
        {
            return Ok(recording);
        }
        let success = recording.success.len();
        Err(self.unfit(format!(
            "{positions} positions, {velocities} velocities and {success} values of success of \
             {steps} steps"
        )))
    }

    fn ask<T>(
        &self,
        question: impl FnOnce(&Bound<'_, PyAny>) -> PyResult<T>,
    ) -> Result<T, PythonError> {
        Python::attach(|py| {
            question(self.env.bind(py)).map_err(|error| PythonError::exception(py, &error))
        })
    }

    fn unfit(&self, reason: String) -> PythonError {
        PythonError::Interface { task_id: self.spec().id.clone(), name: "recording", reason }
    }
}
