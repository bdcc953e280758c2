//! The rule by which a goal-conditioned environment rewards a step, so that the learner can compute
//! the reward for another goal.
//!
//! A worker proves the rule against the environment's own function before anything uses it
//! (`envs_py/dmprl/goal_rule.py`).

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Reward and end of an episode as functions of the distance between achieved and desired goal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GoalRule {
    /// First entry of the achieved goal in an observation.
    pub achieved: usize,
    /// First entry of the desired goal in an observation.
    pub desired: usize,
    /// Number of entries of each goal, G.
    pub goal_len: usize,
    /// Entries of a goal that the distance depends on, each below G.
    pub components: Vec<usize>,
    /// Norm of the difference of the goals.
    pub norm: Norm,
    /// The reward.
    pub reward: GoalReward,
    /// Largest distance at which the episode ends; `None`: it does not end at the goal.
    pub ends_within: Option<f64>,
}

/// Norm of the difference of two goals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Norm {
    /// Square root of the sum of squares.
    Euclidean,
    /// Largest absolute value.
    Max,
}

/// Reward of a step, from the distance after it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum GoalReward {
    /// One of two values.
    Sparse {
        /// Largest distance at which the goal is reached.
        threshold: f64,
        /// Reward of a step that reaches the goal.
        reached: f64,
        /// Reward of any other step.
        missed: f64,
    },
    /// The distance times `factor`.
    Dense {
        /// Usually -1.
        factor: f64,
    },
}

/// Why a rule cannot be used.
#[derive(Debug, Error)]
#[error("goal rule: {name} does not fit a goal of {goal_len} in {observation_len} entries")]
pub struct GoalRuleError {
    /// Name of the field.
    pub name: &'static str,
    /// Length of the goal, G.
    pub goal_len: usize,
    /// Length of an observation.
    pub observation_len: usize,
}

impl GoalRule {
    /// Checks positions and numbers.
    ///
    /// # Errors
    /// The name of the first field that does not fit observations of `observation_len` entries.
    pub fn check(&self, observation_len: usize) -> Result<(), GoalRuleError> {
        let Self { achieved, desired, goal_len, .. } = *self;
        let inside = |first: usize| {
            goal_len > 0 && first.checked_add(goal_len).is_some_and(|end| end <= observation_len)
        };
        let components =
            !self.components.is_empty() && self.components.iter().all(|&index| index < goal_len);
        let is_distance = |value: f64| value.is_finite() && value >= 0.0;
        let reward = match self.reward {
            GoalReward::Sparse { threshold, reached, missed } => {
                is_distance(threshold) && reached.is_finite() && missed.is_finite()
            }
            GoalReward::Dense { factor } => factor.is_finite(),
        };
        let fields = [
            ("achieved", inside(achieved)),
            ("desired", inside(desired) && achieved.abs_diff(desired) >= goal_len),
            ("components", components),
            ("reward", reward),
            ("ends_within", self.ends_within.is_none_or(is_distance)),
        ];
        match fields.iter().find(|(_, fits)| !fits) {
            Some(&(name, _)) => Err(GoalRuleError { name, goal_len, observation_len }),
            None => Ok(()),
        }
    }

    /// Returns the achieved goal of an observation, (G,).
    #[must_use]
    pub fn achieved<'a>(&self, observation: &'a [f32]) -> &'a [f32] {
        &observation[self.achieved..self.achieved + self.goal_len]
    }

    /// Returns the desired goal of an observation, (G,).
    #[must_use]
    pub fn desired<'a>(&self, observation: &'a [f32]) -> &'a [f32] {
        &observation[self.desired..self.desired + self.goal_len]
    }

    /// Sets the desired goal of an observation.
    pub fn set_desired(&self, observation: &mut [f32], goal: &[f32]) {
        observation[self.desired..self.desired + self.goal_len].copy_from_slice(goal);
    }

    /// Returns the distance of two goals, (G,).
    ///
    /// Goals are stored in 32 bits and compared in 64. The result is the environment's for the
    /// rounded goals; a step whose distance differs from the threshold by less than the rounding
    /// may be decided differently from the environment's own 64-bit step.
    #[must_use]
    pub fn distance(&self, achieved: &[f32], desired: &[f32]) -> f64 {
        let differences = self
            .components
            .iter()
            .map(|&index| f64::from(achieved[index]) - f64::from(desired[index]));
        match self.norm {
            Norm::Euclidean => differences.map(|d| d * d).sum::<f64>().sqrt(),
            Norm::Max => differences.fold(0.0, |largest, d| largest.max(d.abs())),
        }
    }

    /// Returns the reward of a step that ends at `distance` from the goal.
    #[must_use]
    pub fn reward(&self, distance: f64) -> f32 {
        match self.reward {
            GoalReward::Sparse { threshold, reached, .. } if distance <= threshold => {
                reached as f32
            }
            GoalReward::Sparse { missed, .. } => missed as f32,
            GoalReward::Dense { factor } => (factor * distance) as f32,
        }
    }

    /// Returns whether a step that ends at `distance` from the goal ends the episode.
    #[must_use]
    pub fn ends(&self, distance: f64) -> bool {
        self.ends_within.is_some_and(|within| distance <= within)
    }

    /// Returns the smallest and the largest discounted return that a sparse reward allows, or
    /// `None` if the return is unbounded.
    #[must_use]
    pub fn return_range(&self, discount: f64) -> Option<[f32; 2]> {
        let GoalReward::Sparse { reached, missed, .. } = self.reward else { return None };
        if discount >= 1.0 {
            return None;
        }
        let horizon = 1.0 / (1.0 - discount);
        // A terminated episode has a return of zero from there on.
        let (low, high) = (reached.min(missed).min(0.0), reached.max(missed).max(0.0));
        Some([(low * horizon) as f32, (high * horizon) as f32])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rule() -> GoalRule {
        GoalRule {
            achieved: 0,
            desired: 3,
            goal_len: 3,
            components: vec![0, 1],
            norm: Norm::Euclidean,
            reward: GoalReward::Sparse { threshold: 0.5, reached: 0.0, missed: -1.0 },
            ends_within: None,
        }
    }

    #[test]
    fn distance_depends_on_norm_and_components_only() {
        let (achieved, desired) = ([3.0, 4.0, 9.0], [0.0, 0.0, 0.0]);
        assert_eq!(rule().distance(&achieved, &desired), 5.0);
        assert_eq!(GoalRule { norm: Norm::Max, ..rule() }.distance(&achieved, &desired), 4.0);
    }

    #[test]
    fn reward_and_end_are_decided_at_the_threshold() {
        let ends = GoalRule { ends_within: Some(0.25), ..rule() };
        let at = |distance| (ends.reward(distance), ends.ends(distance), rule().ends(distance));
        assert_eq!(at(0.25), (0.0, true, false));
        assert_eq!(at(0.5), (0.0, false, false));
        assert_eq!(at(0.5_f64.next_up()), (-1.0, false, false));
        let dense = GoalRule { reward: GoalReward::Dense { factor: -2.0 }, ..rule() };
        assert_eq!(dense.reward(1.5), -3.0);
    }

    #[test]
    fn sparse_returns_are_bounded_and_dense_ones_are_not() {
        assert_eq!(rule().return_range(0.75), Some([-4.0, 0.0]));
        assert_eq!(rule().return_range(1.0), None);
        let reward = GoalReward::Sparse { threshold: 0.5, reached: 1.0, missed: 0.0 };
        assert_eq!(GoalRule { reward, ..rule() }.return_range(0.5), Some([0.0, 2.0]));
        let reward = GoalReward::Dense { factor: -1.0 };
        assert_eq!(GoalRule { reward, ..rule() }.return_range(0.5), None);
    }

    #[test]
    fn rule_that_does_not_fit_the_observation_is_rejected() {
        rule().check(6).unwrap();
        for (broken, name) in [
            (GoalRule { achieved: usize::MAX, ..rule() }, "achieved"),
            (GoalRule { desired: 2, ..rule() }, "desired"),
            (GoalRule { components: vec![3], ..rule() }, "components"),
            (GoalRule { reward: GoalReward::Dense { factor: f64::NAN }, ..rule() }, "reward"),
            (GoalRule { ends_within: Some(-1.0), ..rule() }, "ends_within"),
        ] {
            assert_eq!(broken.check(6).unwrap_err().name, name);
        }
        assert_eq!(rule().check(5).unwrap_err().name, "desired");
    }
}
