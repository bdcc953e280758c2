//! Tests of consecutive segments: continuity at their borders, and convergence.

use super::test_support::{Draw, INTEGRATORS};
use super::*;
use crate::config::{CanonicalIntegration, DmpConfig};

/// The unforced system is time-invariant, so with f = 0 and one goal, segments with carry equal one
/// long movement. `paper` is excluded, because it restarts each segment with ydd_0 = 0.
#[test]
fn unforced_segments_with_carry_equal_one_long_movement() {
    for integrator in [INTEGRATORS[0], INTEGRATORS[1]] {
        let dmp = Dmp::new(&DmpConfig { integrator, ..DmpConfig::default() }, 5).unwrap();
        let start = State { y: 0.3, yd: -4.0 };
        let whole = dmp.system().integrate(start, 0.8, [0.0; 120]);
        let mut state = start;
        for segment in 0..3 {
            let path = dmp.integrate(state, 0.8, &[0.0; 5]);
            for j in 0..=40 {
                assert!((path.y[j] - whole.y[40 * segment + j]).abs() < 1e-12);
                assert!((path.yd[j] - whole.yd[40 * segment + j]).abs() < 1e-12);
            }
            state = State { y: path.y[40], yd: path.yd[40] };
        }
    }
}

/// Runs three segments of random goals and weights with carry through the f32 map. Returns the
/// largest jumps of y, yd and ydd at the borders, between the last sample of one segment and the
/// first *step* of the next (K = m here, so the map returns every step).
fn jumps(integration_steps: usize, config: &DmpConfig) -> [f32; 3] {
    let config = DmpConfig { integration_steps, ..config.clone() };
    let dmp = Dmp::new(&config, integration_steps).unwrap();
    let map = SegmentMap::new(&dmp, dmp.omega() * dmp.omega());
    let mut draw = Draw::new("carry", 0);
    let (m, omega) = (integration_steps, dmp.omega() as f32);
    let mut end: Option<[f32; 3]> = None;
    let (mut state, mut largest) = ((0.2, 1.0), [0.0_f32; 3]);
    for _ in 0..3 {
        let mut inputs = vec![state.0, state.1];
        inputs.extend((0..=dmp.basis_count()).map(|_| draw.uniform(1.0) as f32));
        let mut samples = vec![0.0; 3 * m];
        map.forward(&inputs, &mut samples);
        let at =
            |j: usize| [samples[j], samples[m + j] * omega, samples[2 * m + j] * omega * omega];
        if let Some(end) = end {
            for (largest, (next, end)) in largest.iter_mut().zip(at(0).into_iter().zip(end)) {
                *largest = largest.max((next - end).abs());
            }
        }
        end = Some(at(m - 1));
        state = map.end_state(&samples);
    }
    largest
}

/// With carry, position and velocity at a border differ only by the change within one step, so
/// their jumps shrink with the step size. Acceleration, and in general the action, jumps with the
/// new goal and weights for any step size.
#[test]
fn with_carry_position_and_velocity_are_continuous_across_segments_and_acceleration_is_not() {
    for integrator in INTEGRATORS {
        // With `exact` the phase does not depend on the step size.
        let config = DmpConfig {
            integrator,
            canonical: CanonicalIntegration::Exact,
            ..DmpConfig::default()
        };
        let (coarse, fine) = (jumps(40, &config), jumps(640, &config));
        for (kind, name) in ["y", "yd"].into_iter().enumerate() {
            let ratio = coarse[kind] / fine[kind];
            // `paper` keeps yd constant in its first step, so its jump is only a rounding error.
            let is_rounding = coarse[kind] < 1e-5;
            assert!(is_rounding || (8.0..32.0).contains(&ratio), "{integrator:?} {name} {ratio}");
        }
        assert!(fine[2] > coarse[2] / 2.0 && fine[2] > 1.0, "{integrator:?} ydd {fine:?}");
    }
}

#[test]
fn segments_with_carry_through_the_f32_map_match_the_reference() {
    for integrator in INTEGRATORS {
        let dmp = Dmp::new(&DmpConfig { integrator, ..DmpConfig::default() }, 5).unwrap();
        let omega = dmp.omega();
        let map = SegmentMap::new(&dmp, omega * omega);
        let mut draw = Draw::new("chain", 0);
        let mut state = State { y: 0.0, yd: 0.0 };
        let mut fast = (0.0_f32, 0.0_f32);
        for _ in 0..20 {
            let (_, goal, weights) = draw.parameters(&dmp);
            let path = dmp.integrate(state, goal, &weights);
            state = State { y: path.y[40], yd: path.yd[40] };
            let mut inputs = vec![fast.0, fast.1, goal as f32];
            inputs.extend(weights.iter().map(|w| (w / (omega * omega)) as f32));
            let mut samples = [0.0; 15];
            map.forward(&inputs, &mut samples);
            fast = map.end_state(&samples);
            assert!((f64::from(fast.0) - state.y).abs() < 1e-5);
            assert!((f64::from(fast.1) - state.yd).abs() < 1e-4);
        }
    }
}

#[test]
fn segments_without_weights_converge_to_the_goal() {
    for integrator in INTEGRATORS {
        for alpha_y in [5.0, 10.0, 25.0] {
            let config = DmpConfig { integrator, alpha_y, ..DmpConfig::default() };
            let map = SegmentMap::new(&Dmp::new(&config, 5).unwrap(), 1.0);
            let mut state = (-0.9_f32, 3.0_f32);
            let mut samples = [0.0; 15];
            for _ in 0..20 {
                map.forward(&[state.0, state.1, 0.7, 0.0, 0.0, 0.0, 0.0, 0.0], &mut samples);
                state = map.end_state(&samples);
            }
            assert!(
                (state.0 - 0.7).abs() < 1e-5 && state.1.abs() < 1e-4,
                "{integrator:?} {state:?}"
            );
        }
    }
}
