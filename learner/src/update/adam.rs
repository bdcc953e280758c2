//! The state of Adam (Kingma & Ba 2015, Algorithm 1) for one network. `kernels` has its arithmetic.

use serde::{Deserialize, Serialize};

use super::kernels::StepSizes;

/// Adam's state for one network.
#[derive(Debug, Clone, PartialEq)]
pub struct Adam {
    learning_rate: f64,
    /// Running moments of the gradient.
    pub moments: Moments,
    /// Steps done.
    pub step: StepCount,
}

/// First and second moment of the gradient, (P,) each.
#[derive(Debug, Clone, PartialEq)]
pub struct Moments {
    /// Running mean of the gradient.
    pub first: Vec<f32>,
    /// Running mean of the gradient's square.
    pub second: Vec<f32>,
}

/// Number of steps done, for the bias correction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct StepCount(pub u64);

impl Adam {
    /// Makes the optimiser of `len` parameters.
    #[must_use]
    pub fn new(len: usize, learning_rate: f64) -> Self {
        Self {
            learning_rate,
            moments: Moments { first: vec![0.0; len], second: vec![0.0; len] },
            step: StepCount::default(),
        }
    }

    /// Returns the configured learning rate.
    #[must_use]
    pub fn learning_rate(&self) -> f64 {
        self.learning_rate
    }

    /// Counts a step and returns its factors.
    pub fn next_step(&mut self) -> StepSizes {
        self.step.0 += 1;
        StepSizes::new(self.learning_rate, self.step.0)
    }
}
