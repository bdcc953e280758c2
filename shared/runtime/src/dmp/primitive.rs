//! A DMP with precomputed constants: phases, features, and the matrix of a whole segment.
//!
//! It is built once from the configuration. `SegmentMap` derives the fast map from it.

use super::{
    Basis, CanonicalSystem, DmpError, State, Trajectory, TransformationSystem, feature_matrix,
    forcing_factor,
};
use crate::config::{DmpConfig, ForcingScaling};

/// Number of the map's inputs that precede the weights: y0, yd0, g.
pub const STATE_INPUTS: usize = 3;

/// A DMP with duration tau = 1 per segment, shared by all action dimensions.
#[derive(Debug, Clone, PartialEq)]
pub struct Dmp {
    system: TransformationSystem<f64>,
    forcing_scaling: ForcingScaling,
    basis: Basis,
    /// x_0 .. x_m.
    phases: Vec<f64>,
    /// Phi at x_1 .. x_m: (m, N), row-major.
    features: Vec<f64>,
    segment_steps: usize,
    integration_steps: usize,
    /// (3K) x (3 + N), row-major.
    matrix: Vec<f64>,
}

impl Dmp {
    /// Creates a DMP and computes its constants.
    /// - `segment_steps`: K.
    /// # Errors
    /// `Parameter` in these cases:
    /// - m or K is zero, or m is not a multiple of K.
    /// - `alpha_y` is not positive, or the integrator is unstable with m steps
    ///   ([`crate::config::Integrator::alpha_y_max`]).
    /// - `alpha_x` is not positive or not less than m.
    /// - N is too small for the basis.
    pub fn new(config: &DmpConfig, segment_steps: usize) -> Result<Self, DmpError> {
        let integration_steps = config.integration_steps;
        check(config, segment_steps)?;
        let dt = 1.0 / integration_steps as f64;
        let basis = Basis::new(config.basis_count, config.alpha_x, config.widths)?;
        let canonical =
            CanonicalSystem { alpha_x: config.alpha_x, tau: 1.0, integration: config.canonical };
        let phases = canonical.phases(dt, integration_steps);
        let features = feature_matrix(&basis, &phases[1..]);
        let mut dmp = Self {
            system: TransformationSystem {
                alpha_y: config.alpha_y,
                tau: 1.0,
                dt,
                integrator: config.integrator,
            },
            forcing_scaling: config.forcing_scaling,
            basis,
            phases,
            features,
            segment_steps,
            integration_steps,
            matrix: Vec::new(),
        };
        dmp.matrix = dmp.segment_matrix();
        Ok(dmp)
    }

    /// Number of samples per segment, K.
    #[must_use]
    pub fn segment_steps(&self) -> usize {
        self.segment_steps
    }

    /// Number of integration steps per segment, m.
    #[must_use]
    pub fn integration_steps(&self) -> usize {
        self.integration_steps
    }

    /// Number of basis functions, N.
    #[must_use]
    pub fn basis_count(&self) -> usize {
        self.basis.count()
    }

    /// Natural frequency omega = alpha_y / 2 \[1/s\].
    #[must_use]
    pub fn omega(&self) -> f64 {
        self.system.alpha_y / 2.0
    }

    /// Factor on the forcing term.
    #[must_use]
    pub fn forcing_scaling(&self) -> ForcingScaling {
        self.forcing_scaling
    }

    /// The basis functions.
    #[must_use]
    pub fn basis(&self) -> &Basis {
        &self.basis
    }

    /// Phases x_0 .. x_m, (m + 1,).
    #[must_use]
    pub fn phases(&self) -> &[f64] {
        &self.phases
    }

    /// The transformation system, with tau = 1 and dt = 1 / m.
    #[must_use]
    pub fn system(&self) -> &TransformationSystem<f64> {
        &self.system
    }

    /// Features phi at x_1 .. x_m, (m, N), row-major: the factors of the weights in step j.
    #[must_use]
    pub fn features(&self) -> &[f64] {
        &self.features
    }

    /// Computes all m + 1 samples of a segment of duration tau = 1 by stepping. This is the
    /// reference implementation.
    /// - `weights`: (N,) \[u/s^2\].
    /// # Panics
    /// If `weights` is not N long.
    #[must_use]
    pub fn integrate(&self, start: State<f64>, goal: f64, weights: &[f64]) -> Trajectory<f64> {
        self.integrate_over(1.0, start, goal, weights)
    }

    /// Like [`integrate`](Self::integrate), but for a segment of duration `tau` in m steps. If
    /// `start.yd` is divided by `tau` too, the path is the same and the speed is divided by `tau`.
    /// - `tau`: \[s\], positive. `weights`: (N,) \[u/s^2 at tau = 1\].
    /// # Panics
    /// If `weights` is not N long.
    #[must_use]
    pub fn integrate_over(
        &self,
        tau: f64,
        start: State<f64>,
        goal: f64,
        weights: &[f64],
    ) -> Trajectory<f64> {
        assert_eq!(weights.len(), self.basis_count(), "one weight per basis function");
        let factor = forcing_factor(self.forcing_scaling, start.y, goal);
        let system = TransformationSystem { tau, dt: self.system.dt * tau, ..self.system };
        let forcing = self
            .features
            .chunks_exact(self.basis_count())
            .map(|phi| factor * phi.iter().zip(weights).map(|(phi, w)| phi * w).sum::<f64>());
        system.integrate(start, goal, forcing)
    }

    /// The segment as a matrix: samples = matrix * (y0, yd0, g, w_1 .. w_N).
    ///
    /// (3K) x (3 + N), row-major, f64. The rows are y_1 .. y_K, yd_1 .. yd_K, ydd_1 .. ydd_K.
    /// Sample k is the state after k m / K steps. The start is not included, so that the first
    /// action depends on g and w. With goal scaling the weights' columns are for g - y0 = 1; the
    /// caller multiplies them by g - y0.
    #[must_use]
    pub fn matrix(&self) -> &[f64] {
        &self.matrix
    }

    /// Computes the matrix. The map has no constant term, so each column is the response to a unit
    /// input.
    fn segment_matrix(&self) -> Vec<f64> {
        let (n, m, k_count) = (self.basis_count(), self.integration_steps, self.segment_steps);
        let columns = STATE_INPUTS + n;
        let mut matrix = vec![0.0; 3 * k_count * columns];
        for column in 0..columns {
            let unit = |input| f64::from(u8::from(column == input));
            let start = State { y: unit(0), yd: unit(1) };
            let forcing = (0..m).map(|step| match column.checked_sub(STATE_INPUTS) {
                Some(i) => self.features[step * n + i],
                None => 0.0,
            });
            let response = self.system.integrate(start, unit(2), forcing);
            for k in 0..k_count {
                let sample = response.sample((k + 1) * (m / k_count));
                for (kind, value) in [sample.y, sample.yd, sample.ydd].into_iter().enumerate() {
                    matrix[(kind * k_count + k) * columns + column] = value;
                }
            }
        }
        matrix
    }
}

fn check(config: &DmpConfig, segment_steps: usize) -> Result<(), DmpError> {
    let steps = config.integration_steps;
    DmpError::parameter(
        segment_steps > 0,
        "policy.segment_steps",
        || "1 or more".into(),
        segment_steps,
    )?;
    DmpError::parameter(
        steps > 0 && steps.is_multiple_of(segment_steps),
        "dmp.integration_steps",
        || format!("a multiple of policy.segment_steps = {segment_steps}"),
        steps,
    )?;
    let (alpha_x, alpha_y) = (config.alpha_x, config.alpha_y);
    let max = config.integrator.alpha_y_max(1.0 / steps as f64);
    DmpError::parameter(
        alpha_y > 0.0 && alpha_y < max,
        "dmp.alpha_y",
        || format!("above 0 and below {max:.2}, the stability limit of {:?}", config.integrator),
        alpha_y,
    )?;
    // At alpha_x >= m, explicit Euler's factor 1 - alpha_x / m is not positive. The exact phase
    // would be defined, but a phase that decays within one step does not shape the motion.
    DmpError::parameter(
        alpha_x > 0.0 && alpha_x < steps as f64,
        "dmp.alpha_x",
        || format!("above 0 and below dmp.integration_steps = {steps}"),
        alpha_x,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{BasisWidths, Integrator};

    #[test]
    fn invalid_parameter_is_rejected_by_name() {
        let config = DmpConfig::default();
        let rejected = |config: DmpConfig, steps| match Dmp::new(&config, steps).unwrap_err() {
            DmpError::Parameter { name, .. } => name,
            other => panic!("{other}"),
        };
        let base = || config.clone();
        assert_eq!(rejected(base(), 0), "policy.segment_steps");
        assert_eq!(rejected(base(), 7), "dmp.integration_steps");
        assert_eq!(
            rejected(DmpConfig { integration_steps: 0, ..base() }, 5),
            "dmp.integration_steps"
        );
        for alpha_y in [0.0, -1.0, f64::NAN, f64::INFINITY, 66.3] {
            assert_eq!(rejected(DmpConfig { alpha_y, ..base() }, 5), "dmp.alpha_y");
        }
        let unstable = DmpConfig { alpha_y: 36.6, integrator: Integrator::Paper, ..base() };
        assert_eq!(rejected(unstable, 5), "dmp.alpha_y");
        for alpha_x in [0.0, f64::NAN, 40.0] {
            assert_eq!(rejected(DmpConfig { alpha_x, ..base() }, 5), "dmp.alpha_x");
        }
        assert_eq!(rejected(DmpConfig { basis_count: 0, ..base() }, 5), "dmp.basis_count");
        let single = DmpConfig { basis_count: 1, widths: BasisWidths::Overlap, ..base() };
        assert_eq!(rejected(single, 5), "dmp.basis_count");
    }

    #[test]
    fn halving_tau_halves_the_duration_of_the_same_path() {
        for integrator in [Integrator::SemiImplicit, Integrator::Explicit, Integrator::Paper] {
            let dmp = Dmp::new(&DmpConfig { integrator, ..DmpConfig::default() }, 5).unwrap();
            let weights = [10.0, -20.0, 30.0, 0.0, 5.0];
            let slow = dmp.integrate(State { y: 0.2, yd: 0.7 }, -1.0, &weights);
            let fast = dmp.integrate_over(0.5, State { y: 0.2, yd: 1.4 }, -1.0, &weights);
            for j in 0..=40 {
                let (slow, fast) = (slow.sample(j), fast.sample(j));
                assert!((fast.y - slow.y).abs() < 1e-12);
                assert!((fast.yd - 2.0 * slow.yd).abs() < 1e-11);
                assert!((fast.ydd - 4.0 * slow.ydd).abs() < 1e-10);
            }
        }
    }

    #[test]
    fn without_goal_scaling_shifting_start_and_goal_shifts_the_path() {
        let dmp = Dmp::new(&DmpConfig::default(), 5).unwrap();
        for row in dmp.matrix()[..5 * 8].chunks_exact(8) {
            assert!((row[0] + row[2] - 1.0).abs() < 1e-12, "y0 and g contribute all of y");
        }
    }
}
