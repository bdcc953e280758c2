//! The policy, its limits and its hold, one control step after the other.

mod deadline;
mod error;
mod safety;
#[cfg(test)]
mod tests;

use std::path::Path;

use deadline::Deadline;
pub use error::RuntimeError;
pub use safety::{HOLD_STEPS_MAX, Safety};

use crate::policy::{Head, Plan, Policy, PolicyWorkspace, SmallBatchNetwork};
use crate::policy_file::{self, OpenedPolicy};
use crate::spec::EnvSpec;

/// Runs a policy on one observation at a time. It allocates memory only on creation.
#[derive(Debug)]
pub struct PolicyRuntime {
    policy: Policy,
    network: SmallBatchNetwork,
    work: PolicyWorkspace,
    safety: Safety,
    deadline: Option<Deadline>,
    /// The policy's input, (O,): the environment's observation, then the state of the DMP or of
    /// the commands.
    seen: Vec<f32>,
    /// State (y, yd) at the next segment's start, (2A,); empty if the policy has none.
    state: Vec<f32>,
    /// The last action as u in [-1, 1], (A,).
    last_u: Vec<f32>,
    /// The actions of the next steps, before limits.
    plan: Plan,
    /// Whether each observation changes the plan.
    is_ensemble: bool,
    /// The next action before limits, (A,), in the environment's units.
    wanted: Vec<f64>,
    /// The segment's actions after limits, (K, A).
    given: Vec<f64>,
    /// Executed steps since the last decision.
    step: usize,
    /// The previous action, (A,).
    previous: Vec<f64>,
    /// Whether any action has been returned since the reset.
    has_acted: bool,
    /// Consecutive calls of [`PolicyRuntime::action`] without an observation.
    missed: usize,
    holding: bool,
}

impl PolicyRuntime {
    /// Loads a policy file, either written by `dmprl export` or from a run's `policies/`, with the
    /// hold that it states.
    ///
    /// # Errors
    /// `File` if it cannot be read or is invalid.
    pub fn load(path: &Path) -> Result<Self, RuntimeError> {
        let OpenedPolicy { policy, snapshot, hold, .. } = policy_file::open(path)?;
        let mut runtime = Self::new(policy, &snapshot.values);
        if let Some(hold) = hold {
            runtime.safety.set_hold(&hold)?;
        }
        Ok(runtime)
    }

    /// Creates a runtime without a hold from a policy and its parameters, (P,).
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
            state: vec![0.0; policy.state_len()],
            last_u: vec![0.0; layout.action_len],
            plan: Plan::new(layout),
            is_ensemble: policy.description().policy.is_ensemble(),
            wanted: vec![0.0; layout.action_len],
            given: vec![0.0; layout.actions_len()],
            step: 0,
            previous: vec![0.0; layout.action_len],
            deadline: None,
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

    /// Sets the longest time between two calls of [`PolicyRuntime::action`]. After a longer one,
    /// the caller was frozen and the robot has executed an old action, so the policy holds: its
    /// next decision is by the observation of the next call.
    ///
    /// - `limit_s`: \[s\].
    /// - `clock`: returns the time \[s\] since any moment, by a clock that never goes backwards.
    ///
    /// # Errors
    /// `NoHold`; `Deadline` if the limit is not positive.
    pub fn set_deadline(
        &mut self,
        limit_s: f64,
        clock: impl Fn() -> f64 + Send + 'static,
    ) -> Result<(), RuntimeError> {
        self.safety.hold()?;
        if limit_s.is_nan() || limit_s <= 0.0 {
            return Err(RuntimeError::Deadline { got: limit_s });
        }
        self.deadline = Some(Deadline::new(limit_s, clock));
        Ok(())
    }

    /// Whether the last action was on the way to the hold or the hold itself: on request, because
    /// observations stopped, or because the caller was frozen.
    #[must_use]
    pub fn is_holding(&self) -> bool {
        self.holding
    }

    /// Starts an episode. The next action starts a plan.
    ///
    /// A rate limit applies from the first action on, relative to the hold.
    ///
    /// - `y0`: start of the DMP, (A,) in units of y, for a policy whose segments start where the
    ///   previous one ended (`policy.start = "carry"` or `"action"`). The default is 0, as in
    ///   training. For `action` it is tanh⁻¹ of the last action, scaled to [-1, 1]; in training it
    ///   is at most 2.99 (an action of 0.995).
    ///
    /// # Errors
    /// `Start` if y0 is not A finite numbers, or if the policy has another start.
    pub fn reset(&mut self, y0: Option<&[f32]>) -> Result<(), RuntimeError> {
        if let Some(y0) = y0 {
            let dims = self.policy.layout().action_len;
            if self.state.is_empty() {
                return Err(RuntimeError::start(
                    "its segments do not start where the previous one ended",
                ));
            }
            if y0.len() != dims || y0.iter().any(|y| !y.is_finite()) {
                return Err(RuntimeError::start(&format!("expected {dims} finite numbers")));
            }
        }
        self.state.fill(0.0);
        if let Some(y0) = y0 {
            self.state[..y0.len()].copy_from_slice(y0);
        }
        self.plan.clear();
        self.missed = 0;
        self.holding = false;
        self.has_acted = false;
        self.restart_deadline();
        Ok(())
    }

    /// Decides the next segment's actions, (K, A), in the environment's units, for a caller that
    /// executes all of them. Drops the rest of the plan.
    ///
    /// - `observation`: (O,) in the environment's units.
    ///
    /// # Errors
    /// If the observation is invalid, or the network's outputs are NaN. Execute
    /// [`PolicyRuntime::hold`] then. The policy continues at the next valid observation.
    pub fn segment(&mut self, observation: &[f64]) -> Result<&[f64], RuntimeError> {
        self.restart_deadline(); // the caller returns after K steps
        self.check(observation)?;
        self.plan.clear();
        self.decide(observation)?;
        self.missed = 0;
        self.holding = false;
        while !self.plan.is_empty() {
            self.give();
        }
        Ok(&self.given)
    }

    /// Returns the next control step's action, (A,), in the environment's units.
    ///
    /// With `policy.execution = "ensemble"` the policy decides from every observation and blends
    /// the new segment with the rest of its plan. With `"segment"` it decides at a segment's first
    /// step; within the segment, observations only reset the watchdog.
    ///
    /// - `observation`: (O,) in the environment's units; `None` if there is no new one since the
    ///   last call. After more than [`Safety::hold_after`] calls with `None`, or with `None` where
    ///   no action is planned, or after the deadline, the action is the hold, and the next
    ///   observation starts a new plan.
    ///
    /// # Errors
    /// As [`PolicyRuntime::segment`], at every step; `NoHold` with `None`.
    pub fn action(&mut self, observation: Option<&[f64]>) -> Result<&[f64], RuntimeError> {
        if self.deadline.as_mut().is_some_and(Deadline::is_late) {
            // The observation may be from before the freeze.
            self.holding = true;
            observation.map_or(Ok(()), |observation| self.check(observation))?;
            return self.approach_hold();
        }
        match observation {
            Some(observation) => {
                if self.holding {
                    self.plan.clear();
                }
                if self.is_ensemble || self.plan.is_empty() {
                    self.decide(observation)?;
                } else {
                    self.check(observation)?;
                }
                self.missed = 0;
                self.holding = false;
            }
            None => {
                self.safety.hold()?;
                self.missed = self.missed.saturating_add(1);
                self.holding |= self.missed > self.safety.hold_after();
                self.holding |= self.plan.is_empty();
            }
        }
        if self.holding {
            return self.approach_hold();
        }
        self.give();
        Ok(&self.previous)
    }

    /// Returns an action that moves towards the hold within the rate limit, (A,). Use it after an
    /// error, and whenever the policy must not act. The next observation starts a new segment.
    ///
    /// # Errors
    /// `NoHold`.
    pub fn hold(&mut self) -> Result<&[f64], RuntimeError> {
        if let Some(deadline) = &mut self.deadline {
            deadline.is_late(); // records the call
        }
        self.holding = true;
        self.approach_hold()
    }

    /// Sends actions that move towards the hold within the rate limit, one per control step, until
    /// the last one is the hold. Returns their number. Call it at the end of every drive, also
    /// after an error or a signal.
    ///
    /// - `send`: sends the action to the robot and waits for the end of the control step.
    ///
    /// # Errors
    /// `NoHold`, and the first error of `send`. After the latter the robot did not get the hold.
    pub fn hold_until_reached<E: From<RuntimeError>>(
        &mut self,
        mut send: impl FnMut(&[f64]) -> Result<(), E>,
    ) -> Result<usize, E> {
        for sent in 1..=HOLD_STEPS_MAX {
            let action = self.hold()?;
            send(action)?;
            if self.previous == self.safety.hold()? {
                return Ok(sent);
            }
        }
        Err(RuntimeError::HoldNotReached.into())
    }

    fn restart_deadline(&mut self) {
        if let Some(deadline) = &mut self.deadline {
            deadline.restart();
        }
    }

    fn approach_hold(&mut self) -> Result<&[f64], RuntimeError> {
        self.begin_at_hold();
        self.safety.limit(self.safety.hold()?, &mut self.previous);
        self.follow_command();
        Ok(&self.previous)
    }

    /// Sets the previous action to the hold if no action has been returned yet. Without a hold
    /// there is no rate limit either, so the previous action does not matter.
    fn begin_at_hold(&mut self) {
        if !std::mem::replace(&mut self.has_acted, true)
            && let Ok(hold) = self.safety.hold()
        {
            self.previous.copy_from_slice(hold);
        }
    }

    /// Limits the next planned action, if there is one, and writes it to `given` and `previous`.
    fn give(&mut self) {
        let Some(u) = self.plan.take() else { return };
        self.policy.scaling().apply(u, &mut self.wanted);
        self.begin_at_hold();
        self.safety.limit(&self.wanted, &mut self.previous);
        let dims = self.previous.len();
        self.given[self.step * dims..(self.step + 1) * dims].copy_from_slice(&self.previous);
        self.step += 1;
        if self.policy.carries_dmp_state()
            && let (Head::Dmp(head), Some(dmp)) = (self.policy.head(), &self.work.dmp)
        {
            head.state_at(dmp, 0, self.step, &mut self.state);
        }
        self.follow_command();
    }

    /// Advances the state of the commands by the previous action: the one after limits, because
    /// the robot got it.
    fn follow_command(&mut self) {
        if let Some(commands) = self.policy.command_state() {
            self.policy.scaling().invert(&self.previous, &mut self.last_u);
            commands.follow(&self.last_u, &mut self.state);
        }
    }

    fn decide(&mut self, observation: &[f64]) -> Result<(), RuntimeError> {
        self.check(observation)?;
        let (of_environment, of_state) = self.seen.split_at_mut(observation.len());
        for (seen, value) in of_environment.iter_mut().zip(observation) {
            *seen = *value as f32;
        }
        of_state.copy_from_slice(&self.state);
        self.network.forward(&self.seen, &mut self.work.activations);
        self.policy.decode(&self.seen, &mut self.work);
        // Far outside the training data, sums of large numbers may be NaN.
        if self.work.actions.iter().any(|u| u.is_nan()) {
            self.plan.clear();
            return Err(RuntimeError::Decision);
        }
        self.plan.add(&self.work.actions);
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
