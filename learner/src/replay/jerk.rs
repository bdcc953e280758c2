//! Jerk of the robot, and its cost.
//!
//! A penalty on changes of actions in the actor's loss knows only the segment that it is computed
//! for. A cost in the reward is part of the value of a segment, so the critic also knows the jerk
//! that a segment causes later.

use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::{PolicyError, check_start_sources};
use dmprl_shared::spec::EnvSpec;

use super::{Replay, Window};

/// The reward that steps lose for jerk.
#[derive(Debug, Clone, PartialEq)]
pub struct JerkCost {
    /// Indices of the velocities in an observation.
    velocities: Vec<usize>,
    /// Reward that a step loses, divided by the sum of |v_{t+1} - 2 v_t + v_{t-1}|.
    factor: f32,
}

impl JerkCost {
    /// Makes the cost of a configuration, or returns `None` if it is 0.
    ///
    /// # Errors
    /// [`PolicyError::StartSources`] if the environment does not have these velocities.
    pub fn from_config(
        config: &ExperimentConfig,
        spec: &EnvSpec,
    ) -> Result<Option<Self>, PolicyError> {
        let cost = config.algorithm.jerk_cost;
        if cost == 0.0 {
            return Ok(None);
        }
        let sources = &config.task.start_sources;
        check_start_sources(sources, spec)?;
        let dt = if spec.control_dt_s > 0.0 { spec.control_dt_s } else { 1.0 };
        let factor = (cost / (sources.len() as f64 * dt * dt)) as f32;
        let velocities = sources.iter().map(|source| source.velocity()).collect();
        Ok(Some(Self { velocities, factor }))
    }

    /// Returns the sum of discount^i c_i over the first `steps` steps of a window. The first step
    /// of an episode costs nothing, and neither does one whose predecessor the replay has lost.
    #[must_use]
    pub fn discounted(&self, replay: &Replay, window: &Window, steps: usize, discount: f32) -> f32 {
        let cost = |step: usize| {
            let before = match step.checked_sub(1) {
                Some(step) => Some(replay.observation_after(window, step)),
                None => replay.observation_before(window),
            };
            before.map_or(0.0, |before| {
                let at = replay.observation_after(window, step);
                let after = replay.observation_after(window, step + 1);
                let change = |&v: &usize| (after[v] - 2.0 * at[v] + before[v]).abs();
                self.factor * self.velocities.iter().map(change).sum::<f32>()
            })
        };
        (0..steps).rev().fold(0.0, |sum, step| cost(step) + discount * sum)
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::StartSource;
    use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TRUNCATED};

    use super::*;
    use crate::learner::tests::spec;

    /// Observations are (position, velocity).
    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 2, observation_len: 2, action_len: 1 };

    /// Inserts an episode of two segments with these velocities.
    fn episode(replay: &mut Replay, [a, b, c, d, e]: [f32; 5]) {
        let first = [9.0, a, 9.0, b, 9.0, c, 0.1, 0.2, -1.0, -1.0];
        let second = [9.0, c, 9.0, d, 9.0, e, 0.1, 0.2, -1.0, -1.0];
        for (block, episode_step, flags) in [(first, 0, 0), (second, 2, TRUNCATED)] {
            let header =
                SegmentHeader { episode_step, steps_len: 2, flags, ..SegmentHeader::default() };
            replay.insert(&header, &block);
        }
    }

    fn config(cost: f64) -> ExperimentConfig {
        let mut config = ExperimentConfig::default();
        config.algorithm.jerk_cost = cost;
        config.task.start_sources = vec![StartSource::Value { index: 0, velocity: 1, scale: -1.0 }];
        config
    }

    fn env(control_dt_s: f64) -> EnvSpec {
        EnvSpec { observation_len: 2, action_len: 1, control_dt_s, ..spec() }
    }

    #[test]
    fn a_step_costs_the_second_difference_of_its_velocities() {
        let mut replay = Replay::new(LAYOUT, 100, 1, 1);
        episode(&mut replay, [0.0, 1.0, 4.0, 4.0, 2.0]); // second differences 2, -3, -2
        let cost = JerkCost::from_config(&config(0.25), &env(0.5)).unwrap().unwrap();
        let of = |slot, offset, discount| {
            let window = replay.window(slot, offset).unwrap();
            cost.discounted(&replay, &window, window.len(), discount)
        };
        // No second difference ends with the first step of an episode. 0.25 / 0.5² is 1.
        assert_eq!((of(0, 0, 0.5), of(0, 1, 0.5), of(1, 0, 0.5)), (1.0, 3.5, 4.0));
        let whole = replay.window(1, 0).unwrap();
        assert_eq!(cost.discounted(&replay, &whole, 1, 0.5), 3.0, "of a step");
    }

    #[test]
    fn without_a_cost_there_is_none_and_velocities_must_exist() {
        assert_eq!(JerkCost::from_config(&config(0.0), &env(0.5)).unwrap(), None);
        let unknown = JerkCost::from_config(&config(1.0), &env(0.0)).unwrap().unwrap();
        assert_eq!(unknown.factor, 1.0, "in units of a step");
        let short = EnvSpec { observation_len: 1, ..env(0.5) };
        let error = JerkCost::from_config(&config(1.0), &short).unwrap_err();
        assert!(error.to_string().contains("task.start_sources"), "{error}");
    }
}
