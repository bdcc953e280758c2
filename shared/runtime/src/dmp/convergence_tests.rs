//! Measures each integrator's order of convergence and stability limit.

use super::test_support::{Draw, INTEGRATORS};
use super::*;
use crate::config::{CanonicalIntegration, DmpConfig, Integrator};

/// Solves the differential equation with the exact phase by the classical Runge-Kutta method in
/// 4000 steps. Its error is far below the measured errors. Returns y and yd at five sample times.
fn reference(dmp: &Dmp, start: State<f64>, goal: f64, weights: &[f64]) -> [State<f64>; 5] {
    let (steps, omega) = (4000, dmp.omega());
    let dt = 1.0 / f64::from(steps);
    let slope = |t: f64, at: State<f64>| State {
        y: at.yd,
        yd: omega * omega * (goal - at.y) - 2.0 * omega * at.yd
            + forcing(dmp.basis(), (-t).exp(), weights),
    };
    let moved = |at: State<f64>, slope: State<f64>, dt: f64| State {
        y: at.y + slope.y * dt,
        yd: at.yd + slope.yd * dt,
    };
    let mut at = start;
    let mut sampled = [start; 5];
    for step in 0..steps {
        let t = f64::from(step) * dt;
        let k1 = slope(t, at);
        let k2 = slope(t + dt / 2.0, moved(at, k1, dt / 2.0));
        let k3 = slope(t + dt / 2.0, moved(at, k2, dt / 2.0));
        let k4 = slope(t + dt, moved(at, k3, dt));
        at = State {
            y: at.y + dt / 6.0 * (k1.y + 2.0 * k2.y + 2.0 * k3.y + k4.y),
            yd: at.yd + dt / 6.0 * (k1.yd + 2.0 * k2.yd + 2.0 * k3.yd + k4.yd),
        };
        if (step + 1) % 800 == 0 {
            sampled[(step / 800) as usize] = at;
        }
    }
    sampled
}

/// Returns the largest errors of y and yd over the sample times and several random parameters.
fn errors(config: &DmpConfig) -> [f64; 2] {
    let dmp = Dmp::new(config, 5).unwrap();
    let mut draw = Draw::new("convergence", 0);
    let mut worst = [0.0_f64; 2];
    for _ in 0..4 {
        let (start, goal, weights) = draw.parameters(&dmp);
        let path = dmp.integrate(start, goal, &weights);
        for (k, exact) in reference(&dmp, start, goal, &weights).iter().enumerate() {
            let got = path.sample((k + 1) * config.integration_steps / 5);
            worst[0] = worst[0].max((got.y - exact.y).abs());
            worst[1] = worst[1].max((got.yd - exact.yd).abs());
        }
    }
    worst
}

/// All three integrators are of first order in y and yd, including `semi_implicit`, which is
/// symplectic Euler (its second-order variants need half steps). They differ in their stability
/// limit.
#[test]
fn every_integrator_converges_with_first_order_in_y_and_yd() {
    for integrator in INTEGRATORS {
        for canonical in [CanonicalIntegration::Euler, CanonicalIntegration::Exact] {
            for alpha_y in [10.0, 25.0] {
                let steps = [320, 640, 1280, 2560];
                let errors = steps.map(|integration_steps| {
                    errors(&DmpConfig {
                        integrator,
                        canonical,
                        alpha_y,
                        integration_steps,
                        ..DmpConfig::default()
                    })
                });
                for (kind, name) in ["y", "yd"].into_iter().enumerate() {
                    let orders: Vec<f64> = errors
                        .windows(2)
                        .map(|pair| (pair[0][kind] / pair[1][kind]).log2())
                        .collect();
                    println!("{integrator:?} {canonical:?} {alpha_y} {name}: {orders:.3?}");
                    assert!((orders[2] - 1.0).abs() < 0.05, "{integrator:?} {name} {orders:?}");
                    let settles = orders
                        .windows(2)
                        .all(|pair| (pair[1] - 1.0).abs() <= (pair[0] - 1.0).abs() + 5e-3);
                    assert!(settles, "{integrator:?} {name} {orders:?}");
                }
            }
        }
    }
}

/// Computes the spectral radius of one unforced step on (y, yd, ydd): |A^n|^(1/n) with n = 2^40, by
/// repeated squaring. This also works for defective matrices and complex eigenvalues.
fn spectral_radius(integrator: Integrator, alpha_y: f64, dt: f64) -> f64 {
    let system = TransformationSystem { alpha_y, tau: 1.0, dt, integrator };
    let mut power = [[0.0; 3]; 3];
    // Uses the transposed matrix, which has the same eigenvalues.
    for (column, response) in power.iter_mut().enumerate() {
        let unit = |row| f64::from(u8::from(row == column));
        let next = system.step(Sample { y: unit(0), yd: unit(1), ydd: unit(2) }, 0.0, 0.0);
        *response = [next.y, next.yd, next.ydd];
    }
    let (mut log_radius, mut exponent) = (0.0, 1.0);
    for _ in 0..40 {
        let size = power.iter().flatten().fold(0.0_f64, |max, v: &f64| max.max(v.abs()));
        log_radius += size.ln() / exponent;
        power.iter_mut().flatten().for_each(|v| *v /= size);
        let mut square = [[0.0; 3]; 3];
        for (row, out) in square.iter_mut().enumerate() {
            for (column, out) in out.iter_mut().enumerate() {
                *out = (0..3).map(|i| power[row][i] * power[i][column]).sum();
            }
        }
        power = square;
        exponent *= 2.0;
    }
    log_radius.exp()
}

#[test]
fn spectral_radius_crosses_one_at_the_limit_of_each_integrator() {
    for (integrator, at_default_step) in INTEGRATORS.into_iter().zip([66.274, 160.0, 36.505]) {
        assert!((integrator.alpha_y_max(0.025) - at_default_step).abs() < 5e-4);
        for dt in [0.1, 0.025, 0.01] {
            let limit = integrator.alpha_y_max(dt);
            let radius = |part: f64| spectral_radius(integrator, part * limit, dt);
            assert!(radius(0.9999) < 1.0 - 1e-6, "{integrator:?} {dt} {}", radius(0.9999));
            assert!(radius(1.0001) > 1.0 + 1e-6, "{integrator:?} {dt} {}", radius(1.0001));
            assert!((0..100).all(|i| radius(0.01 * f64::from(i).max(0.1)) < 1.0), "stable below");
        }
    }
}

/// Expected values: eigenvalues of the step matrices, computed separately.
#[test]
fn spectral_radii_at_the_default_step_match_a_separate_computation() {
    let table = [
        (Integrator::Explicit, [0.9375, 0.875, 0.8125, 0.6875]),
        (Integrator::Paper, [0.949, 0.905, 0.863, 0.819]),
        (Integrator::SemiImplicit, [0.951, 0.912, 0.878, 0.820]),
    ];
    for (integrator, radii) in table {
        for (alpha_y, expected) in [5.0, 10.0, 15.0, 25.0].into_iter().zip(radii) {
            let got = spectral_radius(integrator, alpha_y, 0.025);
            assert!((got - expected).abs() < 6e-4, "{integrator:?} {alpha_y}: {got} {expected}");
        }
    }
    assert!((spectral_radius(Integrator::Paper, 40.0, 0.025) - 1.05).abs() < 5e-3);
}
