//! Compares the fast map with the stepped reference, and its gradients with finite differences.

use super::test_support::{Draw, INTEGRATORS, every_config};
use super::*;
use crate::config::{DmpConfig, ForcingScaling};

/// Returns the K samples of a path in DMP units, in the order of `Dmp::matrix`.
fn samples_of(path: &Trajectory<f64>, k_count: usize) -> Vec<f64> {
    let every = (path.y.len() - 1) / k_count;
    let pick = |values: &[f64]| (1..=k_count).map(|k| values[k * every]).collect::<Vec<_>>();
    [pick(&path.y), pick(&path.yd), pick(&path.ydd)].concat()
}

fn norm(values: impl IntoIterator<Item = f64>) -> f64 {
    values.into_iter().map(|value| value * value).sum::<f64>().sqrt()
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    norm(a.iter().zip(b).map(|(a, b)| a - b))
}

/// Returns the map's inputs (y0, yd0, g, w..), with weights divided by `weight_scale`.
fn inputs_of(start: State<f64>, goal: f64, weights: &[f64], weight_scale: f64) -> Vec<f64> {
    let weights = weights.iter().map(|w| w / weight_scale);
    [start.y, start.yd, goal].into_iter().chain(weights).collect()
}

#[test]
fn matrix_equals_stepped_integration_to_1e_12_in_every_configuration() {
    let mut draw = Draw::new("affine", 0);
    let mut worst = 0.0_f64;
    for config in every_config() {
        for k_count in [1, 4, 5, 40] {
            let dmp = Dmp::new(&config, k_count).unwrap();
            let (start, goal, weights) = draw.parameters(&dmp);
            let mut inputs = inputs_of(start, goal, &weights, 1.0);
            let factor = forcing_factor(config.forcing_scaling, start.y, goal);
            inputs[STATE_INPUTS..].iter_mut().for_each(|w| *w *= factor);
            let got: Vec<f64> = dmp
                .matrix()
                .chunks_exact(inputs.len())
                .map(|row| row.iter().zip(&inputs).map(|(a, b)| a * b).sum())
                .collect();
            let expected = samples_of(&dmp.integrate(start, goal, &weights), k_count);
            let error = distance(&got, &expected) / norm(expected);
            worst = worst.max(error);
            assert!(error < 1e-12, "{error} {config:?}");
        }
    }
    println!("worst relative error {worst:e}");
}

#[test]
fn segment_map_equals_stepped_integration_to_1e_5_in_every_configuration() {
    let mut draw = Draw::new("segment_map", 0);
    let mut worst = 0.0_f64;
    for config in every_config() {
        for k_count in [1, 4, 5, 8] {
            let dmp = Dmp::new(&config, k_count).unwrap();
            let (start, goal, weights) = draw.parameters(&dmp);
            let omega = dmp.omega();
            let weight_scale = 1.3 * omega * omega;
            let map = SegmentMap::new(&dmp, weight_scale);
            let inputs: Vec<f32> =
                inputs_of(start, goal, &weights, weight_scale).iter().map(|&v| v as f32).collect();
            let mut samples = vec![f32::NAN; 3 * k_count];
            map.forward(&inputs, &mut samples);
            let mut expected = samples_of(&dmp.integrate(start, goal, &weights), k_count);
            for (row, value) in expected.iter_mut().enumerate() {
                *value /= omega.powi((row / k_count) as i32);
            }
            let got: Vec<f64> = samples.iter().map(|&v| v.into()).collect();
            let size = norm(expected.iter().copied());
            let error = distance(&got, &expected) / size;
            worst = worst.max(error);
            assert!(error < 1e-5, "{error} {config:?}");
            let (y, yd) = map.end_state(&samples);
            assert!((f64::from(y) - expected[k_count - 1]).abs() < 1e-5 * size);
            assert!((f64::from(yd) / omega - expected[2 * k_count - 1]).abs() < 1e-5 * size);
        }
    }
    println!("worst relative error {worst:e}");
}

#[test]
fn stepping_in_f32_agrees_with_f64_to_1e_5() {
    let mut draw = Draw::new("f32", 0);
    for integrator in INTEGRATORS {
        let dmp = Dmp::new(&DmpConfig { integrator, ..DmpConfig::default() }, 5).unwrap();
        let (start, goal, weights) = draw.parameters(&dmp);
        let forcing: Vec<f64> =
            dmp.phases()[1..].iter().map(|&x| forcing(dmp.basis(), x, &weights)).collect();
        let system = TransformationSystem {
            alpha_y: dmp.system().alpha_y as f32,
            tau: 1.0_f32,
            dt: dmp.system().dt as f32,
            integrator,
        };
        let start_f32 = State { y: start.y as f32, yd: start.yd as f32 };
        let got = system.integrate(start_f32, goal as f32, forcing.iter().map(|&f| f as f32));
        let expected = dmp.integrate(start, goal, &weights);
        let pairs = [(&got.y, &expected.y), (&got.yd, &expected.yd), (&got.ydd, &expected.ydd)];
        for (got, expected) in pairs {
            let got: Vec<f64> = got.iter().map(|&v| v.into()).collect();
            let error = distance(&got, expected) / norm(expected.iter().copied());
            assert!(error < 1e-5, "{integrator:?} {error}");
        }
    }
}

/// Returns sum_k (k + 1) u_k plus the end state's y and yd / omega, a loss whose gradient is
/// different for every sample.
fn loss(map: &SegmentMap, inputs: &[f32], rho: &[f32; 4]) -> f64 {
    let k_count = map.sample_count() / 3;
    let (mut samples, mut actions) = (vec![0.0; 3 * k_count], vec![0.0; k_count]);
    map.forward(inputs, &mut samples);
    act(&samples, rho, &mut actions);
    let actions: f64 = (1..).zip(&actions).map(|(k, &v)| f64::from(k) * f64::from(v.tanh())).sum();
    actions + f64::from(samples[k_count - 1]) + f64::from(samples[2 * k_count - 1])
}

fn gradient(map: &SegmentMap, inputs: &[f32], rho: &[f32; 4]) -> (Vec<f32>, [f32; 4]) {
    let k_count = map.sample_count() / 3;
    let (mut samples, mut actions) = (vec![0.0; 3 * k_count], vec![0.0; k_count]);
    map.forward(inputs, &mut samples);
    act(&samples, rho, &mut actions);
    let slope = |v: f32| 1.0 - v.tanh().powi(2);
    let values_gradient: Vec<f32> =
        (1..).zip(&actions).map(|(k, &v)| k as f32 * slope(v)).collect();
    let mut samples_gradient = vec![f32::NAN; 3 * k_count];
    let of_rho = act_backward(&samples, rho, &values_gradient, &mut samples_gradient);
    samples_gradient[k_count - 1] += 1.0;
    samples_gradient[2 * k_count - 1] += 1.0;
    let mut of_inputs = vec![f32::NAN; inputs.len()];
    map.backward(inputs, &samples_gradient, &mut of_inputs);
    (of_inputs, of_rho)
}

#[test]
fn gradients_through_map_and_inverse_controller_match_central_differences() {
    let step = 2e-3_f32;
    let mut draw = Draw::new("gradient", 0);
    for config in every_config() {
        let dmp = Dmp::new(&config, 5).unwrap();
        let map = SegmentMap::new(&dmp, dmp.omega() * dmp.omega());
        let mut inputs: Vec<f32> =
            (0..map.input_count()).map(|_| draw.uniform(1.0) as f32).collect();
        let mut rho: [f32; 4] = std::array::from_fn(|_| draw.uniform(1.0) as f32);
        let (of_inputs, of_rho) = gradient(&map, &inputs, &rho);
        let size = norm(of_inputs.iter().chain(&of_rho).map(|&v| v.into()));
        let close = |analytic: f32, numeric: f64, what: &str| {
            let error = (f64::from(analytic) - numeric).abs();
            assert!(error < 2e-3 * size, "{what}: {analytic} {numeric} {config:?}");
        };
        for i in 0..inputs.len() {
            let centre = inputs[i];
            let (above, below) = (centre + step, centre - step);
            inputs[i] = above;
            let high = loss(&map, &inputs, &rho);
            inputs[i] = below;
            let low = loss(&map, &inputs, &rho);
            inputs[i] = centre;
            close(of_inputs[i], (high - low) / f64::from(above - below), "input");
        }
        for i in 0..4 {
            let centre = rho[i];
            let (above, below) = (centre + step, centre - step);
            rho[i] = above;
            let high = loss(&map, &inputs, &rho);
            rho[i] = below;
            let low = loss(&map, &inputs, &rho);
            rho[i] = centre;
            close(of_rho[i], (high - low) / f64::from(above - below), "rho");
        }
    }
}

#[test]
fn backward_of_the_map_is_the_transpose_of_its_jacobian_up_to_rounding() {
    // The map is affine in each single input (bilinear with goal scaling), so central differences
    // are exact up to rounding for any step. That allows a smaller tolerance than with the tanh.
    let mut draw = Draw::new("transpose", 0);
    for config in every_config() {
        let dmp = Dmp::new(&config, 5).unwrap();
        let map = SegmentMap::new(&dmp, dmp.omega() * dmp.omega());
        let inputs: Vec<f32> = (0..map.input_count()).map(|_| draw.uniform(1.0) as f32).collect();
        let weights: Vec<f32> = (0..15).map(|_| draw.uniform(1.0) as f32).collect();
        let mut analytic = vec![f32::NAN; inputs.len()];
        map.backward(&inputs, &weights, &mut analytic);
        for i in 0..inputs.len() {
            let at = |shift: f32| {
                let (mut shifted, mut samples) = (inputs.clone(), vec![0.0; 15]);
                shifted[i] += shift;
                map.forward(&shifted, &mut samples);
                samples.iter().zip(&weights).map(|(s, w)| f64::from(s * w)).sum::<f64>()
            };
            let numeric = (at(1.0) - at(-1.0)) / 2.0;
            let error = (numeric - f64::from(analytic[i])).abs();
            assert!(error < 1e-5, "{i}: {numeric} {} {config:?}", analytic[i]);
        }
    }
}

#[test]
fn goal_scaled_weights_have_no_effect_at_the_start_but_change_the_goals_gradient() {
    let config = DmpConfig { forcing_scaling: ForcingScaling::Goal, ..DmpConfig::default() };
    let dmp = Dmp::new(&config, 5).unwrap();
    let map = SegmentMap::new(&dmp, 25.0);
    let mut samples = [f32::NAN; 15];
    map.forward(&[0.5, 0.0, 0.5, 1.0, -1.0, 1.0, 1.0, 1.0], &mut samples);
    assert!(samples[..5].iter().all(|y| (y - 0.5).abs() < 1e-6), "{samples:?}");
    let mut gradient = [f32::NAN; 8];
    map.backward(&[0.5, 0.0, 0.5, 1.0, -1.0, 1.0, 1.0, 1.0], &[1.0; 15], &mut gradient);
    assert!(gradient[3..].iter().all(|g| *g == 0.0));
    let mut unweighted = [f32::NAN; 8];
    map.backward(&[0.5, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0], &[1.0; 15], &mut unweighted);
    assert!((gradient[2] - unweighted[2]).abs() > 1e-3);
}
