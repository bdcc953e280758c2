//! Place and unit of the goals for the outcome model ([`super::outcome`]), with its features.

use dmprl_shared::goal_rule::{GoalReward, GoalRule};

use crate::replay::{Outcome, Replay, Window};

/// Largest motion that the model learns, in thresholds. An object that falls off a table moves
/// farther, and would dominate the squared error.
const MOTION_MAX: f32 = 8.0;

/// Place and unit of the goals in an observation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutcomeShape {
    /// First entry of the achieved goal.
    achieved: usize,
    /// First entry of the desired goal.
    desired: usize,
    /// Number of entries of each goal, G.
    pub goal_len: usize,
    /// Steps of a segment, K.
    pub steps: usize,
    /// The inverse of the goal's threshold.
    per_threshold: f32,
}

impl OutcomeShape {
    /// Returns the shape for a rule and segments of K `steps`, or `None` if the reward is dense.
    #[must_use]
    pub fn new(rule: &GoalRule, steps: usize) -> Option<Self> {
        let GoalReward::Sparse { threshold, .. } = rule.reward else { return None };
        let GoalRule { achieved, desired, goal_len, .. } = *rule;
        let per_threshold = (threshold > 0.0).then(|| (1.0 / threshold) as f32)?;
        Some(Self { achieved, desired, goal_len, steps, per_threshold })
    }

    /// Returns the number of the model's outputs, K G.
    #[must_use]
    pub fn outputs(self) -> usize {
        self.steps * self.goal_len
    }

    /// Returns the number of features, F.
    #[must_use]
    pub fn features_len(self) -> usize {
        self.steps * (2 * self.goal_len + 1)
    }

    /// Writes a_k - a_0 of a sample, (K G,), up to a maximum. After the sample's end the achieved
    /// goal rests.
    pub fn write_motion(self, replay: &Replay, window: &Window, outcome: Outcome, out: &mut [f32]) {
        let achieved = |steps| {
            &replay.observation_after(window, steps)[self.achieved..self.achieved + self.goal_len]
        };
        let start = achieved(0);
        for (step, out) in out.chunks_exact_mut(self.goal_len).enumerate() {
            let after = achieved((step + 1).min(outcome.steps));
            for (out, (after, start)) in out.iter_mut().zip(after.iter().zip(start)) {
                let motion = (after - start) * self.per_threshold;
                *out = motion.clamp(-MOTION_MAX, MOTION_MAX);
            }
        }
    }

    /// Returns entry `index` of d_0 of an observation.
    #[must_use]
    pub fn start(self, observation: &[f32], index: usize) -> f32 {
        let difference = observation[self.desired + index] - observation[self.achieved + index];
        difference * self.per_threshold
    }

    /// Writes the features, (F,), of the distances d_k, (K G,).
    pub fn write_features(self, distances: &[f32], out: &mut [f32]) {
        let width = 2 * self.goal_len + 1;
        let steps = distances.chunks_exact(self.goal_len).zip(out.chunks_exact_mut(width));
        for (distance, out) in steps {
            let (plain, rest) = out.split_at_mut(self.goal_len);
            let (bounded, reached) = rest.split_at_mut(self.goal_len);
            for (index, &d) in distance.iter().enumerate() {
                plain[index] = d / 4.0;
                bounded[index] = (d / 2.0).tanh();
            }
            reached[0] = (length(distance) - 1.0).tanh();
        }
    }

    /// Computes the gradient with respect to d_k, (K G,), from that with respect to the features.
    pub fn features_backward(self, distances: &[f32], gradient: &[f32], out: &mut [f32]) {
        let width = 2 * self.goal_len + 1;
        let steps = distances.chunks_exact(self.goal_len).zip(gradient.chunks_exact(width));
        for ((distance, gradient), out) in steps.zip(out.chunks_exact_mut(self.goal_len)) {
            let size = length(distance);
            let reached = (size - 1.0).tanh();
            // The gradient of |d| at d = 0 is set to 0.
            let along = gradient[2 * self.goal_len] * (1.0 - reached * reached) / size.max(1e-6);
            for (index, (out, &d)) in out.iter_mut().zip(distance).enumerate() {
                let bounded = (d / 2.0).tanh();
                let slope = (1.0 - bounded * bounded) / 2.0;
                *out = gradient[index] / 4.0 + gradient[self.goal_len + index] * slope + along * d;
            }
        }
    }
}

fn length(distance: &[f32]) -> f32 {
    distance.iter().map(|d| d * d).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Windows;
    use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TRUNCATED};

    use super::*;
    use crate::learner::tests::goal_rule;
    use crate::replay::Sampler;

    fn shape() -> OutcomeShape {
        let reward = GoalReward::Sparse { threshold: 0.5, reached: 0.0, missed: -1.0 };
        let rule = GoalRule { goal_len: 2, desired: 2, reward, ..goal_rule() };
        OutcomeShape::new(&rule, 1).unwrap()
    }

    #[test]
    fn features_are_those_worked_by_hand() {
        let shape = shape();
        // The goal is (3, 4) / 2 thresholds away, so |d| = 2.5.
        let observation = [1.0, 2.0, 1.75, 3.0];
        let start = [0, 1].map(|index| shape.start(&observation, index));
        assert_eq!(start, [1.5, 2.0]);
        let mut features = [0.0; 5];
        shape.write_features(&start, &mut features);
        let expected = [0.375, 0.5, 0.75_f32.tanh(), 1.0_f32.tanh(), 1.5_f32.tanh()];
        assert_eq!(features, expected);
        assert_eq!(shape.features_len(), 5);
    }

    #[test]
    fn gradient_of_the_features_is_that_of_small_differences() {
        let shape = shape();
        let distances = [0.3, -0.9];
        let weights = [0.5, -1.0, 2.0, 0.7, -1.5];
        let value = |distances: &[f32]| {
            let mut features = [0.0; 5];
            shape.write_features(distances, &mut features);
            features.iter().zip(weights).map(|(f, w)| f * w).sum::<f32>()
        };
        let mut gradient = [0.0; 2];
        shape.features_backward(&distances, &weights, &mut gradient);
        for index in 0..2 {
            let at = |step: f32| {
                let mut moved = distances;
                moved[index] += step;
                value(&moved)
            };
            let expected = (at(1e-2) - at(-1e-2)) / 2e-2;
            assert!((gradient[index] - expected).abs() < 1e-3, "{gradient:?} {expected}");
        }
    }

    #[test]
    fn motion_is_in_thresholds_and_ends_with_the_sample() {
        let shape = OutcomeShape::new(&goal_rule(), 2).unwrap();
        let layout = SegmentLayout { segment_steps: 2, observation_len: 2, action_len: 1 };
        let mut replay = Replay::new(layout, 8, 1, 1);
        // Achieves 1, 2 and 9 with a threshold of 0.5.
        let block = [1.0, 0.0, 2.0, 0.0, 9.0, 0.0, 0.1, 0.2, -1.0, -1.0];
        let header = SegmentHeader { steps_len: 2, flags: TRUNCATED, ..Default::default() };
        replay.insert(&header, &block);
        let random = dmprl_shared::seeds::stream(1, "test", 0);
        let window = Sampler::new(Windows::Segment, random).draw(&replay).unwrap();
        for (steps, expected) in [(1, [2.0, 2.0]), (2, [2.0, MOTION_MAX])] {
            let mut motion = [0.0; 2];
            let outcome = Outcome { steps, terminated: false };
            shape.write_motion(&replay, &window, outcome, &mut motion);
            assert_eq!(motion, expected);
        }
    }

    #[test]
    fn a_dense_reward_has_no_outcome_model() {
        let dense = GoalRule { reward: GoalReward::Dense { factor: -1.0 }, ..goal_rule() };
        assert_eq!(OutcomeShape::new(&dense, 5), None);
    }
}
