//! Imitation: computes the weights with which a DMP follows a demonstrated movement.
//!
//! Training does not use it; tests do.

use super::least_squares::solve;
use super::{Dmp, DmpError, Trajectory, forcing_factor};

/// With goal scaling, goal and start coincide if they are closer than this fraction of the
/// demonstration's extent.
const GOAL_DISTANCE_MIN: f64 = 1e-9;

/// Goal and weights that reproduce a demonstration.
#[derive(Debug, Clone, PartialEq)]
pub struct Imitation {
    /// Goal g \[u\].
    pub goal: f64,
    /// Weights w, (N,) \[u/s^2\].
    pub weights: Vec<f64>,
}

/// Fits a DMP to `demonstration`, with the last position as goal (paper, equations 11 and 12).
/// - `demonstration`: m + 1 samples at the DMP's integration steps, in DMP time (tau = 1). `ydd[j]`
///   is the acceleration between samples j - 1 and j, as in [`Dmp::integrate`]; `ydd[0]` is not
///   used.
/// # Errors
/// The errors of [`fit_weights`].
pub fn imitate(dmp: &Dmp, demonstration: &Trajectory<f64>) -> Result<Imitation, DmpError> {
    check(dmp, demonstration)?;
    let goal = demonstration.y[dmp.integration_steps()];
    Ok(Imitation { goal, weights: fit_weights(dmp, demonstration, goal)? })
}

/// Fits the weights of a DMP with goal `goal` to the demonstration's accelerations by least
/// squares.
///     f_j = tau^2 ydd_j - alpha_y (beta_y (g - y_{j-1}) - tau yd_{j-1})     (paper, equation 11)
///     w = argmin |Phi w - f|^2 = (Phi^T Phi)^-1 Phi^T f                     (paper, equation 12)
/// Differs from the paper: y and yd are taken one step before ydd, as in the integrators, so that
/// the weights of a DMP's own movement are recovered exactly. With goal scaling f is first divided
/// by g - y0.
/// - `demonstration`: as in [`imitate`].
/// # Errors
/// `Shape` or `NotFinite` unless y, yd and ydd are m + 1 finite samples each; `RankDeficient` if
/// the demonstration does not determine the weights; `GoalEqualsStart` if goal and start coincide,
/// with goal scaling only.
pub fn fit_weights(
    dmp: &Dmp,
    demonstration: &Trajectory<f64>,
    goal: f64,
) -> Result<Vec<f64>, DmpError> {
    check(dmp, demonstration)?;
    let start = demonstration.y[0];
    let factor = forcing_factor(dmp.forcing_scaling(), start, goal);
    let extent = demonstration.y.iter().fold(0.0_f64, |extent, y| extent.max((y - start).abs()));
    if factor.abs() <= GOAL_DISTANCE_MIN * extent {
        return Err(DmpError::GoalEqualsStart { goal, start });
    }
    let target: Vec<f64> = (1..=dmp.integration_steps())
        .map(|j| {
            let (previous, ydd) = (demonstration.sample(j - 1), demonstration.ydd[j]);
            dmp.system().required_forcing(previous, goal, ydd) / factor
        })
        .collect();
    solve(dmp.features(), dmp.basis_count(), &target)
        .map_err(|weight| DmpError::RankDeficient { weight })
}

fn check(dmp: &Dmp, demonstration: &Trajectory<f64>) -> Result<(), DmpError> {
    let samples = dmp.integration_steps() + 1;
    DmpError::values("demonstration.y", &demonstration.y, samples)?;
    DmpError::values("demonstration.yd", &demonstration.yd, samples)?;
    DmpError::values("demonstration.ydd", &demonstration.ydd, samples)
}

#[cfg(test)]
mod tests {
    use super::super::test_support::{Draw, every_config};
    use super::*;
    use crate::config::{DmpConfig, ForcingScaling};
    use crate::dmp::State;

    /// The minimum-jerk path from 0 to 1 in one second.
    fn minimum_jerk(steps: usize) -> Trajectory<f64> {
        let at = |polynomial: fn(f64) -> f64| {
            (0..=steps).map(|j| polynomial(j as f64 / steps as f64)).collect()
        };
        Trajectory {
            y: at(|t| 10.0 * t.powi(3) - 15.0 * t.powi(4) + 6.0 * t.powi(5)),
            yd: at(|t| 30.0 * t.powi(2) - 60.0 * t.powi(3) + 30.0 * t.powi(4)),
            ydd: at(|t| 60.0 * t - 180.0 * t.powi(2) + 120.0 * t.powi(3)),
        }
    }

    /// Returns the largest deviation from the minimum-jerk path, whose length is 1.
    fn deviation(config: &DmpConfig) -> f64 {
        let dmp = Dmp::new(config, 5).unwrap();
        let path = minimum_jerk(config.integration_steps);
        let Imitation { goal, weights } = imitate(&dmp, &path).unwrap();
        let copy = dmp.integrate(State { y: 0.0, yd: 0.0 }, goal, &weights);
        path.y.iter().zip(&copy.y).fold(0.0, |max, (a, b)| f64::max(max, (a - b).abs()))
    }

    #[test]
    fn imitating_a_dmp_recovers_its_weights_in_every_configuration() {
        let mut draw = Draw::new("imitation", 0);
        for config in every_config() {
            let dmp = Dmp::new(&config, 5).unwrap();
            let (start, goal, weights) = draw.parameters(&dmp);
            let demonstration = dmp.integrate(start, goal, &weights);
            let got = fit_weights(&dmp, &demonstration, goal).unwrap();
            let size = weights.iter().fold(0.0_f64, |max, w| max.max(w.abs()));
            for (got, w) in got.iter().zip(&weights) {
                assert!((got - w).abs() < 1e-8 * size, "{config:?}: {got} is not {w}");
            }
        }
    }

    /// Measured deviations: at most 6.6 % of the path with three weights, and 3.8 % with four to
    /// six.
    #[test]
    fn minimum_jerk_path_is_reproduced_in_every_configuration() {
        for config in every_config() {
            let deviation = deviation(&config);
            let limit = if config.basis_count == 3 { 0.08 } else { 0.04 };
            assert!(deviation < limit, "{deviation} {config:?}");
        }
    }

    #[test]
    fn more_basis_functions_and_smaller_steps_reduce_the_deviation() {
        let with = |basis_count, integration_steps| {
            deviation(&DmpConfig { basis_count, integration_steps, ..DmpConfig::default() })
        };
        let (coarse, fine) = (with(5, 40), with(15, 2000));
        assert!(fine < 1e-3 && fine < coarse / 10.0, "{coarse} {fine}");
    }

    #[test]
    fn invalid_demonstrations_are_rejected() {
        let config = DmpConfig { forcing_scaling: ForcingScaling::Goal, ..DmpConfig::default() };
        let dmp = Dmp::new(&config, 5).unwrap();
        let mut back_and_forth = minimum_jerk(40);
        back_and_forth.y[40] = 0.0;
        assert!(matches!(imitate(&dmp, &back_and_forth), Err(DmpError::GoalEqualsStart { .. })));
        let short = minimum_jerk(39);
        assert!(matches!(
            imitate(&dmp, &short),
            Err(DmpError::Shape { expected: 41, got: 40, .. })
        ));
        let mut with_nan = minimum_jerk(40);
        with_nan.ydd[7] = f64::NAN;
        assert!(matches!(imitate(&dmp, &with_nan), Err(DmpError::NotFinite { index: 7, .. })));
        let many = DmpConfig { basis_count: 41, ..DmpConfig::default() };
        let many = Dmp::new(&many, 5).unwrap();
        assert!(matches!(
            imitate(&many, &minimum_jerk(40)),
            Err(DmpError::RankDeficient { weight: 40 })
        ));
    }
}
