//! Canonical system: the phase, which replaces explicit time. Used by `primitive`.

use crate::config::CanonicalIntegration;

/// The canonical system, whose phase x decays from x_0 = 1 towards 0.
///     tau xd = -alpha_x x      (paper, section 2.3)
/// x advances *before* the basis functions are evaluated, so the first integration step uses x_1.
/// The paper does not specify this order; Neural Dynamic Policies uses it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CanonicalSystem {
    /// Decay alpha_x.
    pub alpha_x: f64,
    /// Duration tau \[s\].
    pub tau: f64,
    /// How x is integrated.
    pub integration: CanonicalIntegration,
}

impl CanonicalSystem {
    /// Computes the phases x_0 .. x_steps at the times 0, dt, .., steps * dt.
    /// - `dt`: \[s\].
    /// - Returns (steps + 1,), the first always 1.
    #[must_use]
    pub fn phases(&self, dt: f64, steps: usize) -> Vec<f64> {
        let decay = self.alpha_x * dt / self.tau;
        match self.integration {
            CanonicalIntegration::Euler => {
                std::iter::successors(Some(1.0), |x| Some(x - decay * x)).take(steps + 1).collect()
            }
            CanonicalIntegration::Exact => {
                (0..=steps).map(|step| (-decay * step as f64).exp()).collect()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn phases(integration: CanonicalIntegration, tau: f64, steps: usize) -> Vec<f64> {
        CanonicalSystem { alpha_x: 1.0, tau, integration }.phases(tau / steps as f64, steps)
    }

    #[test]
    fn euler_phase_is_0_975_after_one_step_and_0_3632_after_forty() {
        let x = phases(CanonicalIntegration::Euler, 1.0, 40);
        assert_eq!(x.len(), 41);
        assert_eq!(x[0], 1.0);
        assert!((x[1] - 0.975).abs() < 1e-15);
        assert!((x[40] - 0.975_f64.powi(40)).abs() < 1e-14);
        assert!((x[40] - 0.3632).abs() < 5e-5);
    }

    #[test]
    fn exact_phase_ends_at_one_over_e_for_any_tau_and_step() {
        for (tau, steps) in [(1.0, 40), (0.5, 40), (3.0, 7)] {
            let x = phases(CanonicalIntegration::Exact, tau, steps);
            assert!((x[steps] - (-1.0_f64).exp()).abs() < 1e-15);
        }
    }

    #[test]
    fn euler_phase_approaches_the_exact_one_as_the_step_shrinks() {
        let error = |steps| {
            let (euler, exact) = (CanonicalIntegration::Euler, CanonicalIntegration::Exact);
            (phases(euler, 1.0, steps)[steps] - phases(exact, 1.0, steps)[steps]).abs()
        };
        let ratio = error(400) / error(800);
        assert!((ratio - 2.0).abs() < 0.01, "halving the step should halve the error: {ratio}");
    }
}
