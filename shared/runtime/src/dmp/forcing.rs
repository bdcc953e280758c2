//! The forcing term, which shapes the motion between start and goal. Used by `primitive` and
//! `imitation`.

use super::Basis;
use crate::config::ForcingScaling;

/// Computes the features of the forcing term at phase `x`, which are the factors of the weights.
///     phi_i(x) = x psi_i(x) / sum_j psi_j(x)      (paper, equation 9)
/// - `out`: (N,), overwritten.
/// # Panics
/// If `out` is not N long.
pub fn features(basis: &Basis, x: f64, out: &mut [f64]) {
    basis.normalised(x, out);
    for out in out {
        *out *= x;
    }
}

/// Computes the features at each phase: the transposed matrix Phi of the paper's equation 12.
/// - `phases`: (T,).
/// - Returns (T, N), row-major.
#[must_use]
pub fn feature_matrix(basis: &Basis, phases: &[f64]) -> Vec<f64> {
    let mut matrix = vec![0.0; phases.len() * basis.count()];
    for (row, &x) in matrix.chunks_exact_mut(basis.count()).zip(phases) {
        features(basis, x, row);
    }
    matrix
}

/// Computes the forcing term at phase `x`, before goal scaling.
///     f(x) = sum_i phi_i(x) w_i      (paper, equation 9)
/// - `weights`: (N,) \[u/s^2\].
/// # Panics
/// If `weights` is not N long.
#[must_use]
pub fn forcing(basis: &Basis, x: f64, weights: &[f64]) -> f64 {
    assert_eq!(weights.len(), basis.count(), "one weight per basis function");
    let mut phi = vec![0.0; basis.count()];
    features(basis, x, &mut phi);
    phi.iter().zip(weights).map(|(phi, w)| phi * w).sum()
}

/// Returns the factor on the forcing term: 1, or g - y0 as in Neural Dynamic Policies (not in the
/// paper).
#[must_use]
pub fn forcing_factor(scaling: ForcingScaling, y0: f64, goal: f64) -> f64 {
    match scaling {
        ForcingScaling::None => 1.0,
        ForcingScaling::Goal => goal - y0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::BasisWidths;

    #[test]
    fn forcing_matches_a_value_worked_by_hand() {
        // c = (1, 0.5), h = (2, 8), w = (3, -1), x = 0.75:
        //   psi_1 = exp(-2 * 0.25^2) = exp(-0.125) = 0.882496903
        //   psi_2 = exp(-8 * 0.25^2) = exp(-0.5)   = 0.606530660
        //   sum                                    = 1.489027562
        //   3 * 0.882496903 - 0.606530660          = 2.040960048
        //   2.040960048 / 1.489027562              = 1.370666397
        //   times x = 0.75                         = 1.027999798
        let basis = Basis::from_centres_and_widths(vec![1.0, 0.5], vec![2.0, 8.0]).unwrap();
        let f = forcing(&basis, 0.75, &[3.0, -1.0]);
        assert!((f - 1.027_999_798).abs() < 1e-8, "{f}");
    }

    #[test]
    fn forcing_of_equal_weights_is_weight_times_phase() {
        let basis = Basis::new(5, 1.0, BasisWidths::Ndp).unwrap();
        for x in [1.0, 0.975, 0.5, 0.36] {
            assert!((forcing(&basis, x, &[7.0; 5]) - 7.0 * x).abs() < 1e-12);
        }
    }

    #[test]
    fn goal_scaling_multiplies_by_the_signed_distance() {
        assert_eq!(forcing_factor(ForcingScaling::None, 0.5, -1.0), 1.0);
        assert_eq!(forcing_factor(ForcingScaling::Goal, 0.5, -1.0), -1.5);
    }
}
