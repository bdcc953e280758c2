//! A trained policy next to a robot: from an observation to the actions of a segment, or to one
//! action a control step, without Python, without the run that trained it, and with what a robot
//! needs besides: no observation is acted on that is not one, no action leaves its bounds or moves
//! faster than allowed, and when observations stop, the robot holds.
//!
//! ```
#![doc = include_str!("../../examples/act.rs")]
//! ```
//! `dmprl.Policy` does the same with NumPy (`envs_py/dmprl/policy.py`); a test holds both to each
//! other, and the ONNX graph to both.

mod error;
mod safety;
#[cfg(test)]
mod tests;

use std::path::Path;

pub use error::RuntimeError;
pub use safety::Safety;

use crate::policy::{Head, Policy, PolicyWorkspace, SmallBatchNetwork};
use crate::policy_file::{self, OpenedPolicy};
use crate::spec::EnvSpec;

/// A policy that acts, one observation at a time. It allocates nothing once it is made.
#[derive(Debug)]
pub struct PolicyRuntime {
    policy: Policy,
    network: SmallBatchNetwork,
    work: PolicyWorkspace,
    safety: Safety,
    /// What the policy sees, (O,): the environment's part, then a carried DMP state.
    seen: Vec<f32>,
    /// (y, yd) that the next segment's DMP begins at, (2A,); empty if it is not carried.
    carried: Vec<f32>,
    /// The segment's actions as decided, (K, A), in the environment's units.
    decided: Vec<f64>,
    /// As they were given out, (K, A).
    given: Vec<f64>,
    /// Steps of the segment that were given out; K: a decision is due.
    step: usize,
    /// The action before, (A,); before the first, the hold.
    previous: Vec<f64>,
    /// Whether an action was given out since the reset.
    has_acted: bool,
    /// Calls of [`PolicyRuntime::action`] without an observation, in a row.
    missed: usize,
    holding: bool,
}

impl PolicyRuntime {
    /// Loads a policy file: one that `dmprl export` wrote, or one of a run's `policies/`.
    ///
    /// # Errors
    /// `File` if it cannot be read or says too little.
    pub fn load(path: &Path) -> Result<Self, RuntimeError> {
        let OpenedPolicy { policy, snapshot, .. } = policy_file::open(path)?;
        Ok(Self::new(policy, &snapshot.values))
    }

    /// Acts with a policy and its parameters, (P,).
    ///
    /// # Panics
    /// If there are not as many parameters as the policy has.
    #[must_use]
    pub fn new(policy: Policy, parameters: &[f32]) -> Self {
        assert_eq!(parameters.len(), policy.parameters_len(), "policy parameters");
        let layout = policy.layout();
        let mut network = SmallBatchNetwork::new(policy.shape().clone());
        network.load(&parameters[..policy.shape().parameters_len()]);
        let safety = Safety::new(&policy.description().spec, layout.segment_steps);
        Self {
            work: policy.workspace(1),
            seen: vec![0.0; layout.observation_len],
            carried: vec![0.0; layout.observation_len - policy.env_observation_len()],
            decided: vec![0.0; layout.actions_len()],
            given: vec![0.0; layout.actions_len()],
            step: layout.segment_steps,
            previous: safety.hold().to_vec(),
            has_acted: false,
            missed: 0,
            holding: false,
            network,
            safety,
            policy,
        }
    }

    /// The environment that the policy was trained in: sizes, bounds, names, control period.
    #[must_use]
    pub fn spec(&self) -> &EnvSpec {
        &self.policy.description().spec
    }

    /// K, the control steps of one decision.
    #[must_use]
    pub fn segment_steps(&self) -> usize {
        self.policy.layout().segment_steps
    }

    /// Limits and watchdog.
    #[must_use]
    pub fn safety(&self) -> &Safety {
        &self.safety
    }

    /// As [`PolicyRuntime::safety`], to set them; they hold from the next action on.
    pub fn safety_mut(&mut self) -> &mut Safety {
        &mut self.safety
    }

    /// Whether the last action was the hold: observations had stopped, or it was asked for.
    #[must_use]
    pub fn is_holding(&self) -> bool {
        self.holding
    }

    /// Begins an episode: the next action begins a segment. The robot is taken to have commanded
    /// the hold before, which is where a limited rate begins.
    ///
    /// - `y0`: where the DMP begins, (A,) in units of y, for a policy that carries its state from
    ///   segment to segment (`policy.start = "carry"`); at 0 by default, as in training.
    ///
    /// # Errors
    /// `Start`: y0 is not A finite numbers, or the policy's start is not its own to choose.
    pub fn reset(&mut self, y0: Option<&[f32]>) -> Result<(), RuntimeError> {
        if let Some(y0) = y0 {
            let dims = self.policy.layout().action_len;
            if self.carried.is_empty() {
                return Err(RuntimeError::start("its start comes from the observation"));
            }
            if y0.len() != dims || y0.iter().any(|y| !y.is_finite()) {
                return Err(RuntimeError::start(&format!("expected {dims} finite numbers")));
            }
        }
        self.carried.fill(0.0);
        if let Some(y0) = y0 {
            self.carried[..y0.len()].copy_from_slice(y0);
        }
        self.step = self.segment_steps();
        self.missed = 0;
        self.holding = false;
        self.has_acted = false;
        Ok(())
    }

    /// Decides: the next segment's actions, (K, A), in the environment's units, all to be executed.
    ///
    /// - `observation`: (O,) in the environment's units.
    ///
    /// # Errors
    /// The observation is not one, or what the network makes of it is no action. There is no action
    /// then but [`PolicyRuntime::hold`]; the policy goes on at the next good observation.
    pub fn segment(&mut self, observation: &[f64]) -> Result<&[f64], RuntimeError> {
        self.decide(observation)?;
        self.missed = 0;
        self.holding = false;
        while self.step < self.segment_steps() {
            self.give();
        }
        Ok(&self.given)
    }

    /// The next control step's action, (A,), in the environment's units.
    ///
    /// At a segment's first step the policy decides by the observation; within a segment it moves
    /// on as it has decided, and an observation only tells the watchdog that there are some.
    ///
    /// - `observation`: (O,) in the environment's units; none if no new one has come since the
    ///   last call. After [`Safety::hold_after`] calls without one, and where a decision is due,
    ///   the action is the hold, and the next observation begins a new segment.
    ///
    /// # Errors
    /// As [`PolicyRuntime::segment`], at every step.
    pub fn action(&mut self, observation: Option<&[f64]>) -> Result<&[f64], RuntimeError> {
        match observation {
            Some(observation) => {
                if self.step == self.segment_steps() || self.holding {
                    self.decide(observation)?;
                } else {
                    self.check(observation)?;
                }
                self.missed = 0;
                self.holding = false;
            }
            None => {
                self.missed = self.missed.saturating_add(1);
                self.holding |= self.missed > self.safety.hold_after();
                self.holding |= self.step == self.segment_steps();
            }
        }
        if self.holding {
            self.approach_hold();
        } else {
            self.give();
        }
        Ok(&self.previous)
    }

    /// A control step towards the hold, as far as the rate allows, (A,): what to command after an
    /// error, and whenever the policy is not to act. The next observation begins a new segment.
    pub fn hold(&mut self) -> &[f64] {
        self.holding = true;
        self.approach_hold();
        &self.previous
    }

    fn approach_hold(&mut self) {
        self.begin_at_hold();
        self.safety.approach_hold(&mut self.previous);
    }

    /// The robot is taken to have commanded the hold before its first action.
    fn begin_at_hold(&mut self) {
        if !std::mem::replace(&mut self.has_acted, true) {
            self.previous.copy_from_slice(self.safety.hold());
        }
    }

    /// Gives out the segment's next action, into `given` and `previous`.
    fn give(&mut self) {
        self.begin_at_hold();
        let dims = self.previous.len();
        let cells = self.step * dims..(self.step + 1) * dims;
        self.safety.limit(&self.decided[cells.clone()], &mut self.previous);
        self.given[cells].copy_from_slice(&self.previous);
        self.step += 1;
        if let (Head::Dmp(head), Some(dmp)) = (self.policy.head(), &self.work.dmp)
            && !self.carried.is_empty()
        {
            head.state_at(dmp, 0, self.step, &mut self.carried);
        }
    }

    fn decide(&mut self, observation: &[f64]) -> Result<(), RuntimeError> {
        self.check(observation)?;
        let (of_environment, of_dmp) = self.seen.split_at_mut(observation.len());
        for (seen, value) in of_environment.iter_mut().zip(observation) {
            *seen = *value as f32;
        }
        of_dmp.copy_from_slice(&self.carried);
        self.network.forward(&self.seen, &mut self.work.activations);
        self.policy.decode(&self.seen, &mut self.work);
        // Beyond all that was trained on, sums of large numbers can be no number.
        if self.work.actions.iter().any(|u| u.is_nan()) {
            self.step = self.segment_steps();
            return Err(RuntimeError::Decision);
        }
        self.policy.scaling().apply(&self.work.actions, &mut self.decided);
        self.step = 0;
        Ok(())
    }

    fn check(&self, observation: &[f64]) -> Result<(), RuntimeError> {
        let expected = self.policy.env_observation_len();
        if observation.len() != expected {
            return Err(RuntimeError::Length { expected, got: observation.len() });
        }
        // As the policy sees it: 1e300 is infinite to it.
        match observation.iter().position(|&value| !(value as f32).is_finite()) {
            None => Ok(()),
            Some(index) => Err(RuntimeError::NotFinite {
                index,
                name: self.spec().observation_name(index),
                value: observation[index],
            }),
        }
    }
}
