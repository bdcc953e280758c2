//! Stage 8 of 8, recording: the steps and segments of one episode. Filled by [`crate::evaluate`].

use dmprl_shared::policy::{Head, Primitives};

use crate::policy_runner::PolicyRunner;
use crate::python_env::PythonEnvironments;

/// Steps and segments of an episode of T steps.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Trace {
    /// Actions u of the policy in [-1, 1], (T, A).
    pub u: Vec<f32>,
    /// Rewards, (T,).
    pub rewards: Vec<f64>,
    /// Observations before the first step and after each, (T+1, O).
    pub observations: Vec<f64>,
    /// Actions in the environment's units, (T, A).
    pub actions: Vec<f64>,
    /// Segments in order; an ensemble has one for each step.
    pub segments: Vec<TracedSegment>,
}

/// A segment of a traced episode.
#[derive(Debug, Clone, PartialEq)]
pub struct TracedSegment {
    /// Number of steps of the episode before it.
    pub first_step: usize,
    /// Number of its steps; the last segment of an episode may end early. For an ensemble it is 1.
    pub steps: usize,
    /// Primitives that the policy chose; `None` if it has none.
    pub primitives: Option<Primitives>,
}

impl Trace {
    /// Adds the steps that environment 0 has just run.
    pub(crate) fn add_steps(&mut self, environments: &PythonEnvironments, runner: &PolicyRunner) {
        let policy = &runner.policy;
        let (dims, observation_len) = (policy.layout().action_len, policy.env_observation_len());
        let (first_step, steps) = (self.rewards.len(), environments.steps()[0] as usize);
        // The first row repeats the last one of the segment before.
        let known = usize::from(first_step > 0);
        let observations = &environments.observations()[..(steps + 1) * observation_len];
        self.observations.extend(&observations[known * observation_len..]);
        self.u.extend(&runner.u[..steps * dims]);
        self.actions.extend(&runner.last_actions()[..steps * dims]);
        self.rewards.extend(&environments.rewards()[..steps]);
        let primitives = match (policy.head(), &runner.work.dmp) {
            (Head::Dmp(head), Some(work)) => Some(head.primitives(work, 0)),
            _ => None,
        };
        self.segments.push(TracedSegment { first_step, steps, primitives });
    }
}
