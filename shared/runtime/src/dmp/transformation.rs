//! Transformation system: a spring-damper driven by the forcing term, stepped through time.
//!
//! It is the reference in the tests of the affine map. `primitive` computes the forcing values that
//! are passed in here.

use crate::config::Integrator;
use std::ops::{Add, Div, Mul, Sub};

mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// Precision in which a transformation system is stepped: `f32` or `f64`.
pub trait Real:
    sealed::Sealed
    + Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
{
    /// Rounds `value` to this precision.
    fn from_f64(value: f64) -> Self;
}

impl Real for f32 {
    fn from_f64(value: f64) -> Self {
        value as f32
    }
}

impl Real for f64 {
    fn from_f64(value: f64) -> Self {
        value
    }
}

/// Start of a movement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct State<T> {
    /// Position y \[u\].
    pub y: T,
    /// Velocity yd \[u/s\].
    pub yd: T,
}

/// State of a movement after one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample<T> {
    /// Position y \[u\].
    pub y: T,
    /// Velocity yd \[u/s\].
    pub yd: T,
    /// Acceleration ydd \[u/s^2\], computed in the step to this sample.
    pub ydd: T,
}

/// A movement in m steps: m + 1 samples each, of which index 0 is the start.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory<T> {
    /// Positions y, (m + 1,) \[u\].
    pub y: Vec<T>,
    /// Velocities yd, (m + 1,) \[u/s\].
    pub yd: Vec<T>,
    /// Accelerations ydd, (m + 1,) \[u/s^2\]. `ydd[0]` is 0, as in the paper, because no step leads
    /// to the start.
    pub ydd: Vec<T>,
}

impl<T: Real> Trajectory<T> {
    /// The sample after `step` steps.
    /// # Panics
    /// If `step` exceeds m.
    #[must_use]
    pub fn sample(&self, step: usize) -> Sample<T> {
        Sample { y: self.y[step], yd: self.yd[step], ydd: self.ydd[step] }
    }

    fn push(&mut self, sample: Sample<T>) {
        self.y.push(sample.y);
        self.yd.push(sample.yd);
        self.ydd.push(sample.ydd);
    }
}

/// The transformation system with its step size.
///     tau^2 ydd = alpha_y (beta_y (g - y) - tau yd) + f      (paper, equation 8)
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransformationSystem<T> {
    /// Stiffness alpha_y; beta_y is a quarter of it, for critical damping.
    pub alpha_y: T,
    /// Duration tau \[s\].
    pub tau: T,
    /// Step size \[s\].
    pub dt: T,
    /// Order in which position, velocity and acceleration advance.
    pub integrator: Integrator,
}

impl<T: Real> TransformationSystem<T> {
    /// Advances by one step of `dt`.
    ///
    /// With j the step, and ydd_j = ydd(y_{j-1}, yd_{j-1}, f_j) in all three:
    /// - `SemiImplicit`: yd_j = yd_{j-1} + ydd_j dt; y_j = y_{j-1} + yd_j dt.
    /// - `Explicit`: yd_j as above; y_j = y_{j-1} + yd_{j-1} dt.
    /// - `Paper`: yd_j = yd_{j-1} + ydd_{j-1} dt; y_j = y_{j-1} + yd_{j-1} dt (equation 14).
    ///
    /// - `f`: forcing of this step, f(x_j), including goal scaling \[u/s^2\].
    #[must_use]
    pub fn step(&self, previous: Sample<T>, goal: T, f: T) -> Sample<T> {
        let ydd = (self.pull(previous, goal) + f) / (self.tau * self.tau);
        match self.integrator {
            Integrator::SemiImplicit => {
                let yd = previous.yd + ydd * self.dt;
                Sample { y: previous.y + yd * self.dt, yd, ydd }
            }
            Integrator::Explicit => {
                let yd = previous.yd + ydd * self.dt;
                Sample { y: previous.y + previous.yd * self.dt, yd, ydd }
            }
            Integrator::Paper => {
                let yd = previous.yd + previous.ydd * self.dt;
                Sample { y: previous.y + previous.yd * self.dt, yd, ydd }
            }
        }
    }

    /// Computes the forcing for which [`step`](Self::step) gives the acceleration `ydd`.
    ///     f_j = tau^2 ydd_j - alpha_y (beta_y (g - y_{j-1}) - tau yd_{j-1})   (paper, eq. 11)
    /// The paper uses the same index throughout; this is the exact inverse of the step.
    #[must_use]
    pub fn required_forcing(&self, previous: Sample<T>, goal: T, ydd: T) -> T {
        self.tau * self.tau * ydd - self.pull(previous, goal)
    }

    /// Advances by one step per forcing value.
    /// - `forcing`: f(x_1), f(x_2), ... \[u/s^2\], including goal scaling.
    pub fn integrate(
        &self,
        start: State<T>,
        goal: T,
        forcing: impl IntoIterator<Item = T>,
    ) -> Trajectory<T> {
        let mut sample = Sample { y: start.y, yd: start.yd, ydd: T::from_f64(0.0) };
        let mut trajectory = Trajectory { y: vec![], yd: vec![], ydd: vec![] };
        trajectory.push(sample);
        for f in forcing {
            sample = self.step(sample, goal, f);
            trajectory.push(sample);
        }
        trajectory
    }

    /// Contribution of spring and damper, alpha_y (beta_y (g - y) - tau yd).
    fn pull(&self, at: Sample<T>, goal: T) -> T {
        let beta_y = self.alpha_y / T::from_f64(4.0);
        self.alpha_y * (beta_y * (goal - at.y) - self.tau * at.yd)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Expected fractions: computed with the released code of Neural Dynamic Policies, after 8, 16,
    /// 24, 32 and 40 steps of 0.025.
    #[test]
    fn unforced_explicit_response_matches_neural_dynamic_policies() {
        let expected = [
            (5.0, [0.085, 0.264, 0.448, 0.603, 0.723]),
            (10.0, [0.264, 0.612, 0.820, 0.922, 0.968]),
            (15.0, [0.459, 0.831, 0.955, 0.989, 0.998]),
            (25.0, [0.769, 0.979, 0.999, 1.0, 1.0]),
        ];
        for (alpha_y, fractions) in expected {
            let system = TransformationSystem {
                alpha_y,
                tau: 1.0,
                dt: 0.025,
                integrator: Integrator::Explicit,
            };
            let path = system.integrate(State { y: 0.0, yd: 0.0 }, 1.0, [0.0; 40]);
            for (k, fraction) in fractions.iter().enumerate() {
                let y: f64 = path.y[8 * (k + 1)];
                assert!((y - fraction).abs() < 6e-4, "alpha_y {alpha_y}: {y} is not {fraction}");
            }
        }
    }

    #[test]
    fn paper_integrator_applies_the_acceleration_one_step_late() {
        let system =
            TransformationSystem { alpha_y: 4.0, tau: 1.0, dt: 0.5, integrator: Integrator::Paper };
        let path = system.integrate(State { y: 0.0, yd: 0.0 }, 1.0, [0.0; 3]);
        // ydd_1 = 4 (1 - 0) = 4, yd_1 = 0 + ydd_0 / 2 = 0, y_1 = 0.
        // ydd_2 = 4 (1 - 0) = 4, yd_2 = 0 + ydd_1 / 2 = 2, y_2 = 0 + yd_1 / 2 = 0.
        // ydd_3 = 4 ((1 - 0) - 2) = -4, yd_3 = 2 + 4 / 2 = 4, y_3 = 0 + yd_2 / 2 = 1.
        assert_eq!(path.ydd, [0.0, 4.0, 4.0, -4.0]);
        assert_eq!(path.yd, [0.0, 0.0, 2.0, 4.0]);
        assert_eq!(path.y, [0.0, 0.0, 0.0, 1.0]);
    }

    #[test]
    fn required_forcing_inverts_a_step() {
        for integrator in [Integrator::SemiImplicit, Integrator::Explicit, Integrator::Paper] {
            let system = TransformationSystem { alpha_y: 15.0, tau: 2.0, dt: 0.05, integrator };
            let previous = Sample { y: 0.3, yd: -1.0, ydd: 2.0 };
            let next = system.step(previous, 0.8, 12.5);
            let f: f64 = system.required_forcing(previous, 0.8, next.ydd);
            assert!((f - 12.5).abs() < 1e-12);
        }
    }

    #[test]
    fn unforced_system_converges_to_the_goal_over_a_long_horizon() {
        for integrator in [Integrator::SemiImplicit, Integrator::Explicit, Integrator::Paper] {
            for alpha_y in [5.0, 10.0, 15.0, 25.0] {
                let system = TransformationSystem { alpha_y, tau: 1.0, dt: 0.025, integrator };
                let start = State { y: -3.0, yd: 20.0 };
                let path = system.integrate(start, 0.7, [0.0; 800]);
                let end: Sample<f64> = path.sample(800);
                assert!((end.y - 0.7).abs() < 1e-9, "{integrator:?} {alpha_y}: {end:?}");
                assert!(end.yd.abs() < 1e-9 && end.ydd.abs() < 1e-9, "{integrator:?}: {end:?}");
            }
        }
    }
}
