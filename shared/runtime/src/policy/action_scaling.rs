//! Scaling from u to the environment's units, per dimension: action = mid + half_range u.
//!
//! half_range is `policy.action_range` times half the environment's range. u is first clipped to
//! [-1, 1], because draws from a Gaussian may be outside.

use crate::spec::EnvSpec;

/// Middle and half range of every action dimension.
#[derive(Debug, Clone, PartialEq)]
pub struct ActionScaling {
    mid: Vec<f64>,
    half_range: Vec<f64>,
}

impl ActionScaling {
    /// Creates the scaling for an environment whose spec has been checked, to the share `range` of
    /// its actions, above 0 and at most 1.
    #[must_use]
    pub fn new(spec: &EnvSpec, range: f64) -> Self {
        let bounds = || spec.action_low.iter().zip(&spec.action_high);
        Self {
            mid: bounds().map(|(low, high)| 0.5 * (low + high)).collect(),
            half_range: bounds().map(|(low, high)| 0.5 * range * (high - low)).collect(),
        }
    }

    /// Returns the smallest and the largest action of a dimension, in the environment's units.
    #[must_use]
    pub fn bounds(&self, dimension: usize) -> [f64; 2] {
        let half_range = self.half_range[dimension];
        [-half_range, half_range].map(|distance| self.mid[dimension] + distance)
    }

    /// Clips and scales `u`, (rows, A), into `actions`, (rows, A) in the environment's units.
    pub fn apply(&self, u: &[f32], actions: &mut [f64]) {
        let dims = self.mid.len();
        for (row, out) in u.chunks_exact(dims).zip(actions.chunks_exact_mut(dims)) {
            for (d, (u, out)) in row.iter().zip(out).enumerate() {
                *out = self.mid[d] + self.half_range[d] * f64::from(u.clamp(-1.0, 1.0));
            }
        }
    }

    /// Computes u, (rows, A), from `actions`, (rows, A), which must be within their bounds.
    pub fn invert(&self, actions: &[f64], u: &mut [f32]) {
        let dims = self.mid.len();
        for (row, out) in actions.chunks_exact(dims).zip(u.chunks_exact_mut(dims)) {
            for (d, (action, u)) in row.iter().zip(out).enumerate() {
                *u = (((action - self.mid[d]) / self.half_range[d]) as f32).clamp(-1.0, 1.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ends_of_u_are_the_ends_of_each_box_also_an_asymmetric_one() {
        let spec = EnvSpec::new("test", 1, &[(-15.0, 15.0), (0.0, 4.0)], 0.0, 0);
        let mut actions = [0.0; 8];
        let u = [-1.0, -1.0, 0.0, 0.0, 1.0, 1.0, -7.0, 1.5];
        ActionScaling::new(&spec, 1.0).apply(&u, &mut actions);
        assert_eq!(actions, [-15.0, 0.0, 0.0, 2.0, 15.0, 4.0, -15.0, 4.0]);
        let mut inverse = [0.0; 6];
        ActionScaling::new(&spec, 1.0).invert(&actions[..6], &mut inverse);
        assert_eq!(inverse, u[..6]);
        let half = ActionScaling::new(&spec, 0.5);
        half.apply(&u, &mut actions);
        assert_eq!(actions, [-7.5, 1.0, 0.0, 2.0, 7.5, 3.0, -7.5, 3.0]);
        half.invert(&[-15.0, 2.5], &mut inverse[..2]);
        assert_eq!(inverse[..2], [-1.0, 0.5], "actions outside the share are clipped");
    }
}
