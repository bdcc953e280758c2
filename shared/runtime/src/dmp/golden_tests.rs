//! Compares the DMP's building blocks with two public packages.
//!
//! tests/golden/dmp/make_golden.py computed the numbers in tests/golden/dmp/golden.json with
//! movement_primitives 0.9.1 and mp-pytorch 0.1.4. Both step semi-implicitly with an exact phase.
//! Where they otherwise differ from our defaults, the tests combine our parts to match them.

use super::*;
use crate::config::{BasisWidths, CanonicalIntegration, Integrator};
use serde_json::Value;

const GOLDEN: &str = include_str!("../../../../tests/golden/dmp/golden.json");

struct Case(Value);

impl Case {
    fn number(&self, key: &str) -> f64 {
        self.0[key].as_f64().expect(key)
    }

    fn numbers(&self, key: &str) -> Vec<f64> {
        self.0[key].as_array().expect(key).iter().map(|v| v.as_f64().expect(key)).collect()
    }

    /// Computes the case's trajectory with `basis`. Step j uses the phase x_{j - `phase_delay`}, as
    /// the package does.
    fn movement(&self, basis: &Basis, phase_delay: usize) -> Trajectory<f64> {
        let tau = self.number("tau");
        let steps = (self.number("inner_steps") as usize) * (self.numbers("y").len() - 1);
        let canonical = CanonicalSystem {
            alpha_x: self.number("alpha_x"),
            tau,
            integration: CanonicalIntegration::Exact,
        };
        let system = TransformationSystem {
            alpha_y: self.number("alpha_y"),
            tau,
            dt: tau / steps as f64,
            integrator: Integrator::SemiImplicit,
        };
        let weights = self.numbers("weights");
        let phases = canonical.phases(system.dt, steps);
        let seen = &phases[1 - phase_delay..][..steps];
        let start = State { y: self.number("y0"), yd: self.number("yd0") };
        let forcing = seen.iter().map(|&x| forcing(basis, x, &weights));
        system.integrate(start, self.number("goal"), forcing)
    }

    fn assert_reproduced(&self, path: &Trajectory<f64>) {
        let every = self.number("inner_steps") as usize;
        for (key, got) in [("y", &path.y), ("yd", &path.yd)] {
            let got: Vec<f64> = got.iter().step_by(every).copied().collect();
            assert_close(&got, &self.numbers(key), key);
        }
    }
}

/// Compares with a tolerance of 1e-12 of the largest value. The packages sum in a different order,
/// and one of them accumulates its time.
fn assert_close(got: &[f64], expected: &[f64], what: &str) {
    assert_eq!(got.len(), expected.len(), "{what}");
    let size = expected.iter().fold(0.0_f64, |max, v| max.max(v.abs()));
    for (index, (got, expected)) in got.iter().zip(expected).enumerate() {
        assert!((got - expected).abs() < 1e-12 * size, "{what}[{index}]: {got} is not {expected}");
    }
}

fn cases(package: &str) -> Vec<Case> {
    let golden: Value = serde_json::from_str(GOLDEN).unwrap();
    let cases = golden[package].as_array().expect(package).clone();
    assert_eq!(cases.len(), 5);
    cases.into_iter().map(Case).collect()
}

#[test]
fn movement_primitives_trajectories_are_reproduced() {
    for case in cases("movement_primitives") {
        let count = case.numbers("weights").len();
        let basis = Basis::new(count, case.number("alpha_x"), BasisWidths::Overlap).unwrap();
        assert_close(basis.centres(), &case.numbers("centres"), "centres");
        assert_close(basis.widths(), &case.numbers("widths"), "widths");
        case.assert_reproduced(&case.movement(&basis, 0));
    }
}

#[test]
fn mp_pytorch_trajectories_are_reproduced() {
    for case in cases("mp_pytorch") {
        let (centres, widths) = (case.numbers("centres"), case.numbers("widths"));
        let ours = Basis::new(centres.len(), case.number("alpha_x"), BasisWidths::Ndp).unwrap();
        assert_close(ours.centres(), &centres, "centres");
        let basis = Basis::from_centres_and_widths(centres, widths).unwrap();
        case.assert_reproduced(&case.movement(&basis, 1));
    }
}

#[test]
fn golden_values_name_the_versions_they_come_from() {
    let golden: Value = serde_json::from_str(GOLDEN).unwrap();
    assert_eq!(golden["versions"]["movement_primitives"], "0.9.1");
    assert_eq!(golden["versions"]["mp-pytorch"], "0.1.4");
}
