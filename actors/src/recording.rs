//! Stage 8 of 8, recording: runs episodes of a saved policy without noise and records each step.
//! Called by the observer's process.

use std::sync::atomic::AtomicBool;

use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::Policy;

use crate::evaluate::{Episodes, Evaluator};
use crate::python_env::{Joints, PythonEnvironments, StepRecording};
use crate::rollout::RolloutError;
use crate::trace::Trace;

/// One episode of T steps.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeRecord {
    /// Seed of the reset.
    pub seed: u64,
    /// Sum of the rewards, as in an evaluation.
    pub return_: f64,
    /// Success at the last step; `None` if the task does not report success.
    pub success: Option<bool>,
    /// Steps and segments.
    pub trace: Trace,
    /// Joints, and success after each step.
    pub recording: StepRecording,
}

/// Records episodes of policies of one architecture.
pub struct Recorder {
    evaluator: Evaluator,
    joints: Joints,
    goal_in_pictures: String,
}

impl Recorder {
    /// Creates a recorder for an environment of [`PythonEnvironments::start_recording`]. `on_steps`
    /// is called after each segment with the number of steps of the episode.
    ///
    /// # Errors
    /// If the policy does not fit the environment, or its joints cannot be read.
    pub fn new(
        config: &ExperimentConfig,
        environment: PythonEnvironments,
        on_steps: Box<dyn FnMut(usize)>,
    ) -> Result<Self, RolloutError> {
        let (joints, goal_in_pictures) = (environment.joints()?, environment.goal_in_pictures()?);
        let evaluator = Evaluator::tracing(config, environment, on_steps)?;
        Ok(Self { evaluator, joints, goal_in_pictures })
    }

    /// Returns the joints of the robot.
    #[must_use]
    pub fn joints(&self) -> &Joints {
        &self.joints
    }

    /// Returns the goal's appearance in pictures, such as `red ball`; empty if unknown.
    #[must_use]
    pub fn goal_in_pictures(&self) -> &str {
        &self.goal_in_pictures
    }

    /// Returns the policy's architecture.
    #[must_use]
    pub fn policy(&self) -> &Policy {
        self.evaluator.policy()
    }

    /// Returns one line for each failure of the environment since the last call.
    pub fn take_failures(&mut self) -> Vec<String> {
        self.evaluator.take_failures()
    }

    /// Runs and records the episode of a seed; returns `None` if a stop was requested.
    ///
    /// # Errors
    /// As [`Evaluator::evaluate`].
    pub fn record(
        &mut self,
        parameters: &[f32],
        seed: u64,
        stop: &AtomicBool,
    ) -> Result<Option<EpisodeRecord>, RolloutError> {
        let episode = Episodes { count: 1, first_seed: seed, stop };
        let Some(evaluation) = self.evaluator.evaluate(parameters, episode)? else {
            return Ok(None);
        };
        let trace = self.evaluator.take_trace();
        let recording = self.evaluator.environments().recording(trace.rewards.len())?;
        Ok(Some(EpisodeRecord {
            seed,
            return_: evaluation.return_mean(),
            success: evaluation.success_rate.map(|rate| rate > 0.0),
            trace,
            recording,
        }))
    }
}
