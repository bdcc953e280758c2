//! Checks of the policy and its DMP: ranges and combinations.

use super::{AlgorithmName, Controller, DmpConfig, PolicyConfig, PolicyKind, RangeError, range};

/// A replay slot stores its number of steps in one byte.
const SEGMENT_STEPS_MAX: usize = 255;
const HIDDEN_MAX: usize = 65_536;

impl PolicyConfig {
    /// Checks the values of the policy and of its DMP, and whether they suit the algorithm.
    ///
    /// # Errors
    /// If a value is out of range or conflicts with another.
    pub fn check(&self, dmp: &DmpConfig, algorithm: AlgorithmName) -> Result<(), RangeError> {
        let counts = [
            ("policy.segment_steps", self.segment_steps, SEGMENT_STEPS_MAX),
            ("dmp.basis_count", dmp.basis_count, 256),
            ("dmp.integration_steps", dmp.integration_steps, 100_000),
        ];
        for (key, got, high) in counts {
            range(key, got, (1..=high).contains(&got), || format!("from 1 to {high}"))?;
        }
        check_hidden("policy.hidden", &self.hidden)?;
        let positive = [
            ("policy.goal_range", self.goal_range),
            ("policy.weight_range", self.weight_range),
            ("policy.rho_range", self.rho_range),
            ("policy.position_scale", self.position_scale),
            ("dmp.alpha_x", dmp.alpha_x),
            ("dmp.alpha_y", dmp.alpha_y),
        ];
        for (key, got) in positive {
            range(key, got, got.is_finite() && got > 0.0, || "a positive number".into())?;
        }
        let share = self.action_range;
        let fits = share > 0.0 && share <= 1.0;
        range("policy.action_range", share, fits, || "above 0, at most 1".into())?;
        if self.kind == PolicyKind::Dmp {
            self.check_dmp(dmp, algorithm)?;
        }
        let on_policy = algorithm == AlgorithmName::Ndp;
        range("policy.kind", self.kind.name(), !on_policy || self.kind == PolicyKind::Dmp, || {
            "dmp with algorithm.name = \"ndp\", which learns only movement primitives".into()
        })
    }

    fn check_dmp(&self, dmp: &DmpConfig, algorithm: AlgorithmName) -> Result<(), RangeError> {
        let steps = self.segment_steps;
        range(
            "dmp.integration_steps",
            dmp.integration_steps,
            dmp.integration_steps.is_multiple_of(steps),
            || format!("a multiple of policy.segment_steps = {steps}"),
        )?;
        let max = dmp.integrator.alpha_y_max(1.0 / dmp.integration_steps as f64);
        range("dmp.alpha_y", dmp.alpha_y, dmp.alpha_y < max, || {
            format!(
                "less than {max:.0}, the stability limit of the {:?} integrator with {} steps; \
                     lower alpha_y or raise dmp.integration_steps",
                dmp.integrator, dmp.integration_steps
            )
        })?;
        let position = self.controller == Controller::Position;
        range("policy.start", "action", !(position && self.follows_actions()), || {
            "another start with policy.controller = \"position\", whose actions are no positions, \
             or another controller"
                .into()
        })?;
        let on_policy = algorithm == AlgorithmName::Ndp;
        range("policy.controller", "position", on_policy || !position, || {
            "inverse, or algorithm.name = \"ndp\", the only algorithm that clips unbounded actions"
                .into()
        })
    }
}

/// Checks the widths of a network's hidden layers.
///
/// # Errors
/// If a width or their number is out of range.
pub fn check_hidden(key: &'static str, hidden: &[usize]) -> Result<(), RangeError> {
    let fits = !hidden.is_empty()
        && hidden.len() <= 16
        && hidden.iter().all(|&width| (1..=HIDDEN_MAX).contains(&width));
    let got = format!("{hidden:?}");
    range(key, got, fits, || format!("1 to 16 widths from 1 to {HIDDEN_MAX}"))
}
