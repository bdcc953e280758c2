//! What Adam (Kingma & Ba 2015, Algorithm 1) keeps of a network; its arithmetic is in `kernels`.

use serde::{Deserialize, Serialize};

use super::kernels::StepSizes;

/// Adam's state for one network.
#[derive(Debug, Clone, PartialEq)]
pub struct Adam {
    learning_rate: f64,
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
            learning_rate,
            moments: Moments { first: vec![0.0; len], second: vec![0.0; len] },
            step: AdamStep::default(),
        }
    }

    /// Step size.
    #[must_use]
    pub fn learning_rate(&self) -> f64 {
        self.learning_rate
    }

    /// Begins the next step.
    pub fn next_step(&mut self) -> StepSizes {
        self.step.0 += 1;
        StepSizes::new(self.learning_rate, self.step.0)
    }
}
