//! Limits on the actions that a robot receives: bounds, a maximum rate, and the hold.

use super::RuntimeError;
use crate::policy::Hold;
use crate::spec::EnvSpec;

/// Maximum number of control steps from any action to the hold. A lower rate is rejected.
pub const HOLD_STEPS_MAX: usize = 10_000;

/// Limits on the returned actions, and the hold, which replaces them when observations stop.
#[derive(Debug, Clone, PartialEq)]
pub struct Safety {
    spec: EnvSpec,
    /// Maximum change of each action dimension between control steps.
    rate: Vec<f64>,
    /// The action that holds the robot, (A,).
    hold: Option<Vec<f64>>,
    hold_after: usize,
}

impl Safety {
    /// Defaults: the environment's bounds, no rate limit, no hold. A hold begins after
    /// `segment_steps` steps without an observation.
    pub(super) fn new(spec: &EnvSpec, segment_steps: usize) -> Self {
        Self {
            spec: spec.clone(),
            rate: vec![f64::INFINITY; spec.action_len],
            hold: None,
            hold_after: segment_steps,
        }
    }

    /// Returns the action that is used when observations stop, (A,).
    ///
    /// # Errors
    /// `NoHold` if neither the policy file nor [`Safety::set_hold`] stated one.
    pub fn hold(&self) -> Result<&[f64], RuntimeError> {
        self.hold.as_deref().ok_or(RuntimeError::NoHold)
    }

    /// Returns the number of control steps without an observation after which the robot holds.
    #[must_use]
    pub fn hold_after(&self) -> usize {
        self.hold_after
    }

    /// Sets the number of control steps without an observation after which the robot holds. Values
    /// above K have no effect, because the next segment needs an observation.
    ///
    /// # Errors
    /// `NoHold`.
    pub fn set_hold_after(&mut self, steps: usize) -> Result<(), RuntimeError> {
        self.hold()?;
        self.hold_after = steps;
        Ok(())
    }

    /// Sets the command that holds the robot.
    ///
    /// # Errors
    /// `Hold` if it is not an action of this policy. The hold is then unchanged.
    pub fn set_hold(&mut self, hold: &Hold) -> Result<(), RuntimeError> {
        self.hold = Some(hold.action(&self.spec)?);
        Ok(())
    }

    /// Sets the maximum change of each action dimension between control steps, (A,) in the
    /// environment's units. Infinity means no limit.
    ///
    /// # Errors
    /// `NoHold`; `Limit` if the number of dimensions is wrong, or with a value the hold could take
    /// more than [`HOLD_STEPS_MAX`] steps. The limits are then unchanged.
    pub fn set_rate(&mut self, rate: &[f64]) -> Result<(), RuntimeError> {
        self.hold()?;
        let dims = self.spec.action_len;
        let fits = |d: usize| rate.get(d).is_some_and(|&value| value >= self.rate_min(d));
        if let Some(dimension) = (0..dims.max(rate.len())).find(|&d| d >= dims || !fits(d)) {
            let got = rate.get(dimension).map_or_else(|| "missing".to_owned(), f64::to_string);
            let expected = if dimension < dims {
                let minimum = self.rate_min(dimension);
                format!("{minimum} or more, to reach the hold in {HOLD_STEPS_MAX} control steps")
            } else {
                format!("{dims} dimensions")
            };
            return Err(RuntimeError::Limit { what: "the rate", dimension, expected, got });
        }
        self.rate.copy_from_slice(rate);
        Ok(())
    }

    /// Returns the rate with which the hold is reached from any action in fewer than
    /// [`HOLD_STEPS_MAX`] steps; the last one makes up for rounding.
    fn rate_min(&self, dimension: usize) -> f64 {
        let range = self.spec.action_high[dimension] - self.spec.action_low[dimension];
        range / (HOLD_STEPS_MAX - 1) as f64
    }

    /// Moves `previous` towards `wanted` as far as the limits allow.
    pub(super) fn limit(&self, wanted: &[f64], previous: &mut [f64]) {
        for (d, (wanted, previous)) in wanted.iter().zip(previous).enumerate() {
            let reach = *previous - self.rate[d]..=*previous + self.rate[d];
            let near = wanted.clamp(*reach.start(), *reach.end());
            *previous = near.clamp(self.spec.action_low[d], self.spec.action_high[d]);
        }
    }
}
