//! Helpers of the DMP tests: a list of configurations, and random parameters with a fixed seed.

use super::{Dmp, State};
use crate::config::{BasisWidths, CanonicalIntegration, DmpConfig, ForcingScaling, Integrator};
use crate::seeds::{Stream, stream};
use rand::RngExt;

pub const INTEGRATORS: [Integrator; 3] =
    [Integrator::SemiImplicit, Integrator::Explicit, Integrator::Paper];

/// Every combination of integrator, forcing scaling, canonical integration and widths, each with N
/// from 3 to 6 and alpha_y from 5 to 25: 24 x 16 configurations.
pub fn every_config() -> impl Iterator<Item = DmpConfig> {
    let mut configs = Vec::new();
    for integrator in INTEGRATORS {
        for forcing_scaling in [ForcingScaling::None, ForcingScaling::Goal] {
            for canonical in [CanonicalIntegration::Euler, CanonicalIntegration::Exact] {
                for widths in [BasisWidths::Ndp, BasisWidths::Overlap] {
                    for basis_count in 3..=6 {
                        for alpha_y in [5.0, 10.0, 15.0, 25.0] {
                            configs.push(DmpConfig {
                                basis_count,
                                alpha_y,
                                integrator,
                                forcing_scaling,
                                canonical,
                                widths,
                                ..DmpConfig::default()
                            });
                        }
                    }
                }
            }
        }
    }
    configs.into_iter()
}

/// Random parameters of the same size as a policy's.
pub struct Draw(pub Stream);

impl Draw {
    pub fn new(name: &str, index: u64) -> Self {
        Self(stream(1, name, index))
    }

    /// Uniform in (-`range`, `range`).
    pub fn uniform(&mut self, range: f64) -> f64 {
        self.0.random_range(-range..range)
    }

    /// Returns a start (y0, yd0), a goal and weights, uniform within 1, omega, 1 and omega^2.
    pub fn parameters(&mut self, dmp: &Dmp) -> (State<f64>, f64, Vec<f64>) {
        let omega = dmp.omega();
        let start = State { y: self.uniform(1.0), yd: self.uniform(omega) };
        let goal = self.uniform(1.0);
        let weights = (0..dmp.basis_count()).map(|_| self.uniform(omega * omega)).collect();
        (start, goal, weights)
    }
}
