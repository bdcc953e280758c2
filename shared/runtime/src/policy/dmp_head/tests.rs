//! Compares the head's gradients with central differences of its forward pass.

use rand::RngExt;

use super::*;
use crate::dmp::State;
use crate::seeds;
use crate::spec::EnvSpec;
use crate::test_support::description;

const ROWS: usize = 3;

fn described(keys: &[(&str, &str)]) -> PolicyDescription {
    let sources = r#"[{ "cos": 0, "sin": 1, "velocity": 2 },
                      { "index": 3, "velocity": 2, "scale": -1.0 }]"#;
    let spec = EnvSpec::new("Test-v0", 4, &[(-1.0, 1.0); 2], 0.02, 10);
    let keys = [&[("start_sources", sources)], keys].concat();
    description(spec, &keys)
}

fn head(keys: &[(&str, &str)]) -> DmpHead {
    DmpHead::new(&described(keys)).unwrap()
}

#[test]
fn gradients_of_all_controllers_equal_central_differences() {
    let observed = ("policy.start", "observed");
    let position = ("policy.controller", "position");
    let goal = ("dmp.forcing_scaling", "goal");
    for keys in [
        &[][..],
        &[observed, goal],
        &[position, ("policy.position_scale", "3.0")],
        &[position, observed, goal, ("dmp.integrator", "explicit")],
        &[("policy.controller", "direct"), observed],
    ] {
        let head = head(keys);
        let len = head.outputs_len();
        let mut random = seeds::stream(1, "test", 0);
        let mut draw = |count: usize| -> Vec<f32> {
            (0..count).map(|_| random.random_range(-1.0..1.0)).collect()
        };
        let (outputs, observations) = (draw(ROWS * len), draw(ROWS * 4));
        let weights = draw(ROWS * 10);
        let mut work = head.workspace(ROWS);
        let mut means = vec![0.0; ROWS * 10];
        let mut sum = |outputs: &[f32], work: &mut DmpWorkspace| -> f64 {
            head.squash(outputs, len, work);
            head.segment(&observations, work, &mut means);
            means.iter().zip(&weights).map(|(m, w)| f64::from(*m) * f64::from(*w)).sum()
        };
        sum(&outputs, &mut work);
        let mut gradient = vec![0.0; ROWS * len];
        let arriving = HeadGradient { means: &weights, end_state: &[] };
        head.backward(&mut work, arriving, &mut gradient, len);
        let step = 1e-2_f32;
        for (index, gradient) in gradient.iter().enumerate() {
            let mut moved = |by: f32| {
                let mut outputs = outputs.clone();
                outputs[index] += by;
                sum(&outputs, &mut work)
            };
            let expected = (moved(step) - moved(-step)) / f64::from(2.0 * step);
            let off = (f64::from(*gradient) - expected).abs();
            assert!(off < 1e-3, "{keys:?}, output {index}: {gradient} {expected}");
        }
    }
}

#[test]
fn primitives_integrate_to_their_positions() {
    for keys in [&[][..], &[("policy.start", "observed"), ("dmp.forcing_scaling", "goal")]] {
        let head = head(keys);
        let len = head.outputs_len();
        let mut random = seeds::stream(1, "primitives", 0);
        let mut draw = |count: usize| -> Vec<f32> {
            (0..count).map(|_| random.random_range(-1.0..1.0)).collect()
        };
        let (outputs, observations) = (draw(ROWS * len), draw(ROWS * 4));
        let (mut work, mut means) = (head.workspace(ROWS), vec![0.0; ROWS * 10]);
        head.squash(&outputs, len, &mut work);
        head.segment(&observations, &mut work, &mut means);
        let row = 1;
        let primitives = head.primitives(&work, row);
        let starts = head.starts(&observations);
        let dmp = Dmp::new(&described(keys).dmp, head.steps).unwrap();
        let every = dmp.integration_steps() / head.steps;
        for d in 0..2 {
            let at = 2 * (row * 2 + d);
            let start = State { y: f64::from(starts[at]), yd: f64::from(starts[at + 1]) };
            assert_eq!(primitives.start[d], starts[at]);
            let weights: Vec<f64> = primitives.weights[d].iter().map(|w| f64::from(*w)).collect();
            let reference = dmp.integrate(start, f64::from(primitives.goal[d]), &weights);
            for (k, positions) in primitives.positions.iter().enumerate() {
                let off = (f64::from(positions[d]) - reference.sample((k + 1) * every).y).abs();
                assert!(off < 1e-4, "{keys:?}, dimension {d}, step {}: off by {off}", k + 1);
            }
        }
    }
}
