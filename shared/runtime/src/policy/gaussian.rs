//! The squashed Gaussian of soft actor-critic: u = tanh(mean + std noise) for each action.

use std::f32::consts::{LN_2, PI};

/// Range to which raw log-stds are clamped, as in the published implementations.
const LOG_STD_MIN: f32 = -20.0;
const LOG_STD_MAX: f32 = 2.0;

/// A drawn action and the values that its gradients need.
#[derive(Debug, Clone, Copy)]
pub struct Draw {
    /// u = tanh(mean + std noise).
    pub action: f32,
    /// Logarithm of the density of u.
    pub log_density: f32,
    /// std noise, which is the derivative of mean + std noise with respect to log-std.
    pub shift: f32,
    /// Whether the raw log-std is within its range; outside, its gradient is zero.
    pub in_range: bool,
}

/// Draws an action from a mean before tanh, a raw log-std and standard normal `noise`.
///
/// log density = log N(noise) - log std - log(1 - u²). The last term is computed as 2 (log 2 - x -
/// softplus(-2x)), which keeps its precision where tanh saturates (Haarnoja et al. 2018, appendix
/// C).
#[must_use]
pub fn draw(mean: f32, raw_log_std: f32, noise: f32) -> Draw {
    let log_std = raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX);
    let shift = log_std.exp() * noise;
    let x = mean + shift;
    let log_normal = -0.5 * (noise * noise + (2.0 * PI).ln()) - log_std;
    Draw {
        action: x.tanh(),
        log_density: log_normal - 2.0 * (LN_2 - x - softplus(-2.0 * x)),
        shift,
        in_range: raw_log_std == log_std,
    }
}

/// log(1 + exp(x)).
fn softplus(x: f32) -> f32 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn density_of_actions_integrates_to_one() {
        // Midpoints of 20 000 slices of (-1, 1); noise = (atanh(u) - mean) / std.
        for (mean, log_std) in [(0.0_f32, -1.0_f32), (0.7, 0.0), (-1.0, -2.0)] {
            let slices = 20_000;
            let width = 2.0 / slices as f32;
            let mass: f64 = (0..slices)
                .map(|slice| {
                    let u = -1.0 + (slice as f32 + 0.5) * width;
                    let drawn = draw(mean, log_std, (u.atanh() - mean) / log_std.exp());
                    assert!((drawn.action - u).abs() < 1e-4);
                    f64::from(drawn.log_density.exp() * width)
                })
                .sum();
            assert!((mass - 1.0).abs() < 1e-3, "{mean} {log_std}: {mass}");
        }
    }

    #[test]
    fn saturated_action_has_a_finite_density() {
        for mean in [-30.0, 30.0] {
            let drawn = draw(mean, 5.0, 0.5);
            assert!(drawn.log_density.is_finite() && !drawn.in_range, "{drawn:?}");
        }
    }
}
