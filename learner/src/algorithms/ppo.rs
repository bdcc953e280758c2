//! Proximal policy optimisation (Schulman et al. 2017) for one action: its log density and the
//! clipped objective.

use std::f32::consts::PI;

/// Returns the log density of `action` under independent Gaussians, (A,) each.
#[must_use]
pub fn log_density(action: &[f32], mean: &[f32], log_std: &[f32]) -> f32 {
    let terms = action.iter().zip(mean).zip(log_std).map(|((action, mean), log_std)| {
        let deviation = (action - mean) * (-log_std).exp();
        -0.5 * (deviation * deviation + (2.0 * PI).ln()) - log_std
    });
    terms.sum()
}

/// Returns the entropy of independent Gaussians \[nat\].
#[must_use]
pub fn entropy(log_std: &[f32]) -> f32 {
    log_std.iter().map(|log_std| log_std + 0.5 * (1.0 + (2.0 * PI).ln())).sum()
}

/// The clipped objective of one action, as a loss.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surrogate {
    /// -min(ratio advantage, clip(ratio, 1 - clip, 1 + clip) advantage) (equation 7).
    pub loss: f32,
    /// Its derivative with respect to the new log density.
    pub slope: f32,
    /// Whether the ratio lies outside the interval.
    pub outside: bool,
    /// (ratio - 1) - log ratio: its mean estimates the divergence of the new policy from the old.
    pub divergence: f32,
}

/// Computes the objective.
///
/// - `log_ratio`: log density under the current policy minus that under the policy that acted.
/// - `clip`: half-width of the interval around 1.
#[must_use]
pub fn surrogate(log_ratio: f32, advantage: f32, clip: f32) -> Surrogate {
    let ratio = log_ratio.exp();
    let plain = ratio * advantage;
    let clipped = ratio.clamp(1.0 - clip, 1.0 + clip) * advantage;
    Surrogate {
        loss: -plain.min(clipped),
        // The clipped objective does not depend on the ratio.
        slope: if plain <= clipped { -plain } else { 0.0 },
        outside: (ratio - 1.0).abs() > clip,
        divergence: ratio - 1.0 - log_ratio,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_objective_is_clipped_where_a_policy_would_gain_by_going_further() {
        // Ratios 1.3 and 0.6 with clip 0.2, for a good and a bad action; worked by hand.
        for (ratio, advantage, loss, slope) in [
            (1.3_f32, 2.0, -2.4, 0.0),
            (1.3, -2.0, 2.6, 2.6),
            (0.6, 2.0, -1.2, -1.2),
            (0.6, -2.0, 1.6, 0.0),
            (1.1, 2.0, -2.2, -2.2),
            (1.1, -2.0, 2.2, 2.2),
        ] {
            let got = surrogate(ratio.ln(), advantage, 0.2);
            assert!((got.loss - loss).abs() < 1e-5, "{ratio} {advantage}: {got:?}");
            assert!((got.slope - slope).abs() < 1e-5, "{ratio} {advantage}: {got:?}");
            assert_eq!(got.outside, (ratio - 1.0).abs() > 0.2);
        }
    }

    #[test]
    fn the_density_is_the_normal_distributions() {
        // log N(0.5; 0.1, 0.3) and log N(-1; 0.2, 2), by the formula in double precision.
        let got = log_density(&[0.5, -1.0], &[0.1, 0.2], &[0.3_f32.ln(), 2.0_f32.ln()]);
        assert!((got - (-0.603_854_6 - 1.792_085_7)).abs() < 1e-5, "{got}");
        // log std + (1 + log 2 pi) / 2 of both.
        let got = entropy(&[0.3_f32.ln(), 2.0_f32.ln()]);
        assert!((got - (0.214_965_7 + 2.112_085_7)).abs() < 1e-5, "{got}");
    }

    #[test]
    fn nothing_diverges_from_itself() {
        let same = surrogate(0.0, 1.5, 0.1);
        assert_eq!(
            (same.loss, same.slope, same.outside, same.divergence),
            (-1.5, -1.5, false, 0.0)
        );
    }
}
