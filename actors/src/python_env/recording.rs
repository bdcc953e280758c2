//! An environment that records each step of its robot (`envs_py/dmprl/recording.py`).

use std::path::Path;

use dmprl_shared::config::TaskConfig;
use pyo3::prelude::*;

use super::environments::read_options;
use super::{Interpreter, PythonEnvironments, PythonError};

/// Kind of a joint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JointKind {
    /// A hinge, whose position is an angle \[rad\].
    Hinge,
    /// A slider, whose position is a length \[m\].
    Slide,
}

/// The robot's joints; empty if the environment does not expose them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Joints {
    /// Name and kind of each joint.
    pub joints: Vec<(String, JointKind)>,
    /// Reason for an empty list; otherwise empty.
    pub why_none: String,
}

/// The Python side's record of an episode of T steps.
#[derive(Debug, Clone, PartialEq)]
pub struct StepRecording {
    /// Joint positions before the first step and after each step, (T+1, J) [rad or m]; empty
    /// without joints.
    pub joint_positions: Vec<Vec<f64>>,
    /// Joint velocities, (T+1, J) [rad/s or m/s].
    pub joint_velocities: Vec<Vec<f64>>,
    /// Success after each step as in [`PythonEnvironments::success`], (T,); empty if it is only
    /// known for segments.
    pub success: Vec<u8>,
    /// Files of pictures, if requested.
    pub frames: Vec<String>,
    /// Number of executed steps at each picture.
    pub frame_steps: Vec<usize>,
}

impl PythonEnvironments {
    /// Creates an environment of a task that records its steps and, if `pictures` is given, draws
    /// them into that folder.
    ///
    /// # Errors
    /// As [`PythonEnvironments::start`]; `Exception` if the environment cannot be drawn.
    pub fn start_recording(
        _interpreter: &Interpreter,
        task: &TaskConfig,
        segment_steps: usize,
        pictures: Option<&Path>,
    ) -> Result<Self, PythonError> {
        Self::start_with(1, segment_steps, |py| {
            let module = py.import("dmprl.recording")?;
            let options = read_options(py, task)?;
            module.getattr("make")?.call1((&task.id, segment_steps, pictures, options))
        })
    }

    /// Returns the goal's appearance in pictures, such as `red ball`; empty if unknown.
    ///
    /// # Errors
    /// `Exception` if the installed package does not fit.
    pub fn goal_in_pictures(&self) -> Result<String, PythonError> {
        self.call(|env| env.call_method0("goal_in_pictures")?.extract())
    }

    /// Returns the robot's joints. Only for environments of
    /// [`PythonEnvironments::start_recording`].
    ///
    /// # Errors
    /// `Exception` or `Interface` if the installed package does not fit.
    pub fn joints(&self) -> Result<Joints, PythonError> {
        let read = |env: &Bound<'_, PyAny>| -> PyResult<_> {
            let joints: Vec<(String, String)> = env.call_method0("joints")?.extract()?;
            Ok((joints, env.call_method0("why_no_joints")?.extract()?))
        };
        let (named, why_none) = self.call(read)?;
        let mut joints = Vec::with_capacity(named.len());
        for (name, kind) in named {
            let kind = match kind.as_str() {
                "hinge" => JointKind::Hinge,
                "slide" => JointKind::Slide,
                other => {
                    let reason = format!("joint {name} is a {other}; expected hinge or slide");
                    return Err(self.interface_error(reason));
                }
            };
            joints.push((name, kind));
        }
        Ok(Joints { joints, why_none })
    }

    /// Returns the recording of the `steps` steps since the last reset with a seed.
    ///
    /// # Errors
    /// `Exception` or `Interface` if the installed package does not fit.
    pub fn recording(&self, steps: usize) -> Result<StepRecording, PythonError> {
        let recording = self.call(|env| -> PyResult<_> {
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
        Err(self.interface_error(format!(
            "{positions} positions, {velocities} velocities and {success} values of success for \
             {steps} steps"
        )))
    }

    /// Calls a function with the Python environment.
    fn call<T>(
        &self,
        function: impl FnOnce(&Bound<'_, PyAny>) -> PyResult<T>,
    ) -> Result<T, PythonError> {
        Python::attach(|py| {
            function(self.env.bind(py)).map_err(|error| PythonError::exception(py, &error))
        })
    }

    fn interface_error(&self, reason: String) -> PythonError {
        PythonError::Interface { task_id: self.spec().id.clone(), name: "recording", reason }
    }
}
