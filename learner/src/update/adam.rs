//! Adam (Kingma & Ba 2015, Algorithm 1) and Polyak averaging, one fused pass each.

use serde::{Deserialize, Serialize};

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
/// Added to the root of the second moment, as PyTorch does.
const EPSILON: f32 = 1e-8;

/// Adam's state for one network.
#[derive(Debug, Clone, PartialEq)]
pub struct Adam {
    learning_rate: f32,
    /// Moments of the gradient, (P,) each.
    pub moments: Moments,
    /// Steps done.
    pub step: AdamStep,
}

/// First and second moment of the gradient.
#[derive(Debug, Clone, PartialEq)]
pub struct Moments {
    /// Running mean of the gradient.
    pub first: Vec<f32>,
    /// Running mean of its square.
    pub second: Vec<f32>,
}

/// Counts steps for the bias correction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct AdamStep(pub u64);

impl Adam {
    /// The optimiser of `len` parameters.
    #[must_use]
    pub fn new(len: usize, learning_rate: f64) -> Self {
        Self {
            learning_rate: learning_rate as f32,
            moments: Moments { first: vec![0.0; len], second: vec![0.0; len] },
            step: AdamStep::default(),
        }
    }

    /// Begins the next step.
    pub fn next_step(&mut self) -> Step {
        self.step.0 += 1;
        // The corrections are computed in f64: 1 - beta2^t loses its digits in f32 at small t.
        let correction = |beta: f32| 1.0 - f64::from(beta).powf(self.step.0 as f64);
        Step {
            size: (f64::from(self.learning_rate) / correction(BETA1)) as f32,
            root: correction(BETA2).sqrt() as f32,
        }
    }
}

/// The bias corrections of one step.
#[derive(Debug, Clone, Copy)]
pub struct Step {
    size: f32,
    root: f32,
}

/// Some of a network's parameters, with all that belongs to them.
#[derive(Debug)]
pub struct Slices<'a> {
    /// The parameters.
    pub parameters: &'a mut [f32],
    /// Their gradient.
    pub gradient: &'a [f32],
    /// First moments.
    pub first: &'a mut [f32],
    /// Second moments.
    pub second: &'a mut [f32],
}

impl Step {
    /// parameters -= learning_rate * m̂ / (sqrt(v̂) + epsilon), with bias-corrected moments;
    /// the target, if any, then moves by its share of the way.
    pub fn update(self, slices: Slices<'_>, follower: Option<(&mut [f32], f32)>) {
        let Slices { parameters, gradient, first, second } = slices;
        let moments = first.iter_mut().zip(second.iter_mut());
        for ((parameter, gradient), (m, v)) in parameters.iter_mut().zip(gradient).zip(moments) {
            *m = BETA1 * *m + (1.0 - BETA1) * gradient;
            *v = BETA2 * *v + (1.0 - BETA2) * gradient * gradient;
            *parameter -= self.size * *m / (v.sqrt() / self.root + EPSILON);
        }
        if let Some((target, share)) = follower {
            polyak(target, parameters, share);
        }
    }
}

/// target <- polyak * network + (1 - polyak) * target.
fn polyak(target: &mut [f32], network: &[f32], polyak: f32) {
    for (target, network) in target.iter_mut().zip(network) {
        *target += polyak * (network - *target);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_steps_worked_in_double_precision() {
        // The definition, evaluated step by step in f64.
        let (mut m, mut v, mut expected) = (0.0_f64, 0.0_f64, 0.5_f64);
        let mut adam = Adam::new(1, 0.1);
        let mut parameters = [0.5_f32];
        for (t, gradient) in [0.3_f64, -0.2, 0.7].into_iter().enumerate() {
            m = 0.9 * m + 0.1 * gradient;
            v = 0.999 * v + 0.001 * gradient * gradient;
            let t = t as i32 + 1;
            expected -= 0.1 * (m / (1.0 - 0.9_f64.powi(t)))
                / ((v / (1.0 - 0.999_f64.powi(t))).sqrt() + 1e-8);
            let step = adam.next_step();
            let Moments { first, second } = &mut adam.moments;
            let gradient = &[gradient as f32];
            let parameters_now = &mut parameters;
            step.update(Slices { parameters: parameters_now, gradient, first, second }, None);
            assert!(
                (f64::from(parameters[0]) - expected).abs() < 1e-6,
                "{parameters:?} {expected}"
            );
        }
    }

    #[test]
    fn polyak_moves_by_its_share() {
        let mut target = [1.0, 2.0];
        polyak(&mut target, &[3.0, 2.0], 0.25);
        assert_eq!(target, [1.5, 2.0]);
    }
}
