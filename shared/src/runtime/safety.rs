//! Limits on the actions that a robot receives: bounds, a maximum rate, and the hold.

use super::RuntimeError;
use crate::spec::EnvSpec;

/// Limits on the returned actions, and the hold, which replaces them when observations stop.
#[derive(Debug, Clone, PartialEq)]
pub struct Safety {
    low: Vec<f64>,
    high: Vec<f64>,
    /// Maximum change of each action dimension between control steps.
    rate: Vec<f64>,
    hold: Vec<f64>,
    hold_after: usize,
}

impl Safety {
    /// Defaults: the environment's bounds, no rate limit, and a hold after `segment_steps` steps
    /// without an observation. The hold is 0 (no torque, no displacement), or the nearest bound.
    pub(super) fn new(spec: &EnvSpec, segment_steps: usize) -> Self {
        let bounds = spec.action_low.iter().zip(&spec.action_high);
        Self {
            hold: bounds.map(|(&low, &high)| 0.0_f64.clamp(low, high)).collect(),
            low: spec.action_low.clone(),
            high: spec.action_high.clone(),
            rate: vec![f64::INFINITY; spec.action_len],
            hold_after: segment_steps,
        }
    }

    /// Returns the action that is used when observations stop, (A,).
    #[must_use]
    pub fn hold(&self) -> &[f64] {
        &self.hold
    }

    /// Returns the number of control steps without an observation after which the robot holds.
    #[must_use]
    pub fn hold_after(&self) -> usize {
        self.hold_after
    }

    /// Sets the number of control steps without an observation after which the robot holds. Values
    /// above K have no effect, because the next segment needs an observation.
    pub fn set_hold_after(&mut self, steps: usize) {
        self.hold_after = steps;
    }

    /// Sets the action that holds the robot, (A,).
    ///
    /// # Errors
    /// `Limit` if the number of dimensions is wrong or a value is out of bounds. The hold is then
    /// unchanged.
    pub fn set_hold(&mut self, hold: &[f64]) -> Result<(), RuntimeError> {
        let expected = |d: usize| format!("{} to {}", self.low[d], self.high[d]);
        self.check("the hold", hold, &expected, |d, value| {
            value >= self.low[d] && value <= self.high[d]
        })?;
        self.hold.copy_from_slice(hold);
        Ok(())
    }

    /// Sets the maximum change of each action dimension between control steps, (A,) in the
    /// environment's units. Infinity means no limit.
    ///
    /// # Errors
    /// `Limit` if the number of dimensions is wrong or a value is not positive. The limits are then
    /// unchanged.
    pub fn set_rate(&mut self, rate: &[f64]) -> Result<(), RuntimeError> {
        let expected = |_| "a positive number".to_owned();
        self.check("the rate", rate, &expected, |_, value| value > 0.0)?;
        self.rate.copy_from_slice(rate);
        Ok(())
    }

    fn check(
        &self,
        what: &'static str,
        values: &[f64],
        expected: &dyn Fn(usize) -> String,
        fits: impl Fn(usize, f64) -> bool,
    ) -> Result<(), RuntimeError> {
        let dims = self.low.len();
        let unfit = values.iter().enumerate().position(|(d, &value)| d >= dims || !fits(d, value));
        let missing = (values.len() < dims).then_some(values.len());
        let Some(dimension) = unfit.or(missing) else { return Ok(()) };
        let got = values.get(dimension).map_or_else(|| "missing".to_owned(), f64::to_string);
        let expected =
            if dimension < dims { expected(dimension) } else { format!("{dims} dimensions") };
        Err(RuntimeError::Limit { what, dimension, expected, got })
    }

    /// Moves `previous` towards `wanted` as far as the limits allow.
    pub(super) fn limit(&self, wanted: &[f64], previous: &mut [f64]) {
        for (d, (wanted, previous)) in wanted.iter().zip(previous).enumerate() {
            let reach = *previous - self.rate[d]..=*previous + self.rate[d];
            *previous = wanted.clamp(*reach.start(), *reach.end()).clamp(self.low[d], self.high[d]);
        }
    }

    /// Moves `previous` towards the hold as far as the limits allow.
    pub(super) fn approach_hold(&self, previous: &mut [f64]) {
        self.limit(&self.hold, previous);
    }
}
