//! Runs a trained policy on a robot, from a policy file and without Python.
//!
//! [`PolicyRuntime`] returns the actions of a segment, or one action per control step. It rejects
//! invalid observations, limits actions to their bounds and their rate to a maximum, and holds the
//! robot when observations stop.
//!
//! ```
#![doc = include_str!("../../examples/act.rs")]
//! ```
//! `dmprl.Policy` is the same runtime in NumPy (`envs_py/dmprl/policy.py`). A test compares both
//! and the ONNX graph.

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

/// Runs a policy on one observation at a time. It allocates memory only on creation.
#[derive(Debug)]
pub struct PolicyRuntime {
    policy: Policy,
    network: SmallBatchNetwork,
    work: PolicyWorkspace,
    safety: Safety,
    /// The policy's input, (O,): the environment's observation, then a carried DMP state.
    seen: Vec<f32>,
    /// Start (y, yd) of the next segment's DMP, (2A,); empty if it is not carried.
    carried: Vec<f32>,
    /// The segment's actions before limits, (K, A), in the environment's units.
    decided: Vec<f64>,
    /// The segment's actions after limits, (K, A).
    given: Vec<f64>,
    /// Executed steps of the segment. At K the next step needs a decision.
    step: usize,
    /// The previous action, (A,); initially the hold.
    previous: Vec<f64>,
    /// Whether any action has been returned since the reset.
    has_acted: bool,
    /// Consecutive calls of [`PolicyRuntime::action`] without an observation.
    missed: usize,
    holding: bool,
}

impl PolicyRuntime {
    /// Loads a policy file, either written by `dmprl export` or from a run's `policies/`.
    ///
    /// # Errors
    /// `File` if it cannot be read or is invalid.
    pub fn load(path: &Path) -> Result<Self, RuntimeError> {
        let OpenedPolicy { policy, snapshot, .. } = policy_file::open(path)?;
        Ok(Self::new(policy, &snapshot.values))
    }

    /// Creates a runtime from a policy and its parameters, (P,).
    ///
    /// # Panics
    /// If the number of parameters is wrong.
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

    /// Returns the spec of the environment that the policy was trained in.
    #[must_use]
    pub fn spec(&self) -> &EnvSpec {
        &self.policy.description().spec
    }

    /// Returns the number of control steps per decision, K.
    #[must_use]
    pub fn segment_steps(&self) -> usize {
        self.policy.layout().segment_steps
    }

    /// Returns the limits and the watchdog's settings.
    #[must_use]
    pub fn safety(&self) -> &Safety {
        &self.safety
    }

    /// Returns the limits and the watchdog's settings. Changes apply from the next action on.
    pub fn safety_mut(&mut self) -> &mut Safety {
        &mut self.safety
    }

    /// Whether the last action was the hold, either on request or because observations stopped.
    #[must_use]
    pub fn is_holding(&self) -> bool {
        self.holding
    }

    /// Starts an episode. The next action starts a segment.
    ///
    /// A rate limit applies from the first action on, relative to the hold.
    ///
    /// - `y0`: start of the DMP, (A,) in units of y, for a policy that carries its state across
    ///   segments (`policy.start = "carry"`). The default is 0, as in training.
    ///
    /// # Errors
    /// `Start` if y0 is not A finite numbers, or if the policy does not carry its state.
    pub fn reset(&mut self, y0: Option<&[f32]>) -> Result<(), RuntimeError> {
        if let Some(y0) = y0 {
            let dims = self.policy.layout().action_len;
            if self.carried.is_empty() {
                return Err(RuntimeError::start("it does not carry its DMP state"));
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

    /// Decides the next segment's actions, (K, A), in the environment's units. All of them must be
    /// executed.
    ///
    /// - `observation`: (O,) in the environment's units.
    ///
    /// # Errors
    /// If the observation is invalid, or the network's outputs are NaN. Execute
    /// [`PolicyRuntime::hold`] then. The policy continues at the next valid observation.
    pub fn segment(&mut self, observation: &[f64]) -> Result<&[f64], RuntimeError> {
        self.decide(observation)?;
        self.missed = 0;
        self.holding = false;
        while self.step < self.segment_steps() {
            self.give();
        }
        Ok(&self.given)
    }

    /// Returns the next control step's action, (A,), in the environment's units.
    ///
    /// At a segment's first step the policy decides from the observation. Within a segment it
    /// executes that decision, and observations only reset the watchdog.
    ///
    /// - `observation`: (O,) in the environment's units; `None` if there is no new one since the
    ///   last call. After more than [`Safety::hold_after`] calls with `None`, or with `None` at a
    ///   segment's first step, the action is the hold, and the next observation starts a new
    ///   segment.
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

    /// Returns an action that moves towards the hold within the rate limit, (A,). Use it after an
    /// error, and whenever the policy must not act. The next observation starts a new segment.
    pub fn hold(&mut self) -> &[f64] {
        self.holding = true;
        self.approach_hold();
        &self.previous
    }

    fn approach_hold(&mut self) {
        self.begin_at_hold();
        self.safety.approach_hold(&mut self.previous);
    }

    /// Sets the previous action to the hold if no action has been returned yet.
    fn begin_at_hold(&mut self) {
        if !std::mem::replace(&mut self.has_acted, true) {
            self.previous.copy_from_slice(self.safety.hold());
        }
    }

    /// Limits the segment's next action and writes it to `given` and `previous`.
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
        // Far outside the training data, sums of large numbers may be NaN.
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
        // The policy reads f32, in which 1e300 is infinite.
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
