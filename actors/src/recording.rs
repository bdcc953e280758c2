//! Stage 8 of 8, beside evaluation: noise-free episodes, one at a time, written down step by step.

use std::sync::atomic::AtomicBool;

use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::Policy;

use crate::evaluate::{Episodes, Evaluator, Trace};
use crate::python_env::{Joints, PythonEnvironments, StepRecording};
use crate::rollout::RolloutError;

/// One episode of T steps.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeRecord {
    /// What it was reset with.
    pub seed: u64,
    /// Sum of its rewards, as an evaluation has it.
    pub return_: f64,
    /// Whether its last step reported success; none if the task reports none.
    pub success: Option<bool>,
    /// Actions and rewards.
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
    /// On the environment of [`PythonEnvironments::start_recording`]; `on_steps` is told after each
    /// segment how many steps its episode has.
    ///
    /// # Errors
    /// If the policy does not fit it, or it cannot tell its joints.
    pub fn new(
        config: &ExperimentConfig,
        environment: PythonEnvironments,
        on_steps: Box<dyn FnMut(usize)>,
    ) -> Result<Self, RolloutError> {
        let (joints, goal_in_pictures) = (environment.joints()?, environment.goal_in_pictures()?);
        let evaluator = Evaluator::tracing(config, environment, on_steps)?;
        Ok(Self { evaluator, joints, goal_in_pictures })
    }

    /// The robot's.
    #[must_use]
    pub fn joints(&self) -> &Joints {
        &self.joints
    }

    /// What the goal looks like in a picture; empty if nobody knows.
    #[must_use]
    pub fn goal_in_pictures(&self) -> &str {
        &self.goal_in_pictures
    }

    /// The policy's architecture.
    #[must_use]
    pub fn policy(&self) -> &Policy {
        self.evaluator.policy()
    }

    /// One line about each failure of the environment since the last call.
    pub fn take_failures(&mut self) -> Vec<String> {
        self.evaluator.take_failures()
    }

    /// Runs the episode of a seed; none if a stop was asked for.
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
