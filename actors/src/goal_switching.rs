//! Stage 3 of 8, goals while exploring: a policy that has reached its goal gets another one. Called
//! by the rollout.
//!
//! A policy that reaches its goal early would rest there until the episode ends, and the replay
//! would hold little of pushing an object that has been pushed before. Only the policy sees the
//! other goal: environment, replay and statistics keep the episode's own, and hindsight replaces it
//! in most windows anyway. It is our own addition (docs/decisions/0121-switching-goals.md).

use dmprl_shared::config::{ExperimentConfig, Hindsight};
use dmprl_shared::goal_rule::{GoalReward, GoalRule};
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;

/// Number of the newest episodes whose desired goals are drawn from.
const KNOWN_MAX: usize = 256;

/// Goals of a worker's policies.
#[derive(Debug)]
pub(crate) struct GoalSwitching {
    rule: GoalRule,
    /// Largest distance at which a goal is reached.
    threshold: f64,
    /// Probability of another goal, for each decision at a goal.
    probability: f64,
    /// The goal that each environment's policy pursues, (E, G).
    pursued: Vec<f32>,
    /// Whether it has one yet; the first decision of an episode takes the episode's own, (E,).
    has_goal: Vec<bool>,
    /// Desired goals of the newest episodes, a ring of (up to 256, G).
    known: Vec<f32>,
    /// Number of episodes so far.
    episodes: usize,
    random: Xoshiro256PlusPlus,
}

impl GoalSwitching {
    /// Returns `None` if it is not configured, or without hindsight or a sparse goal rule.
    pub(crate) fn new(
        rule: Option<&GoalRule>,
        config: &ExperimentConfig,
        random: Xoshiro256PlusPlus,
    ) -> Option<Self> {
        let probability = config.exploration.goal_switches;
        let is_on = probability > 0.0 && config.replay.hindsight != Hindsight::None;
        let rule = rule.filter(|_| is_on)?.clone();
        let GoalReward::Sparse { threshold, .. } = rule.reward else { return None };
        let envs = config.actors.envs_per_worker;
        Some(Self {
            threshold,
            probability,
            pursued: vec![0.0; envs * rule.goal_len],
            has_goal: vec![false; envs],
            known: Vec::with_capacity(KNOWN_MAX * rule.goal_len),
            episodes: 0,
            random,
            rule,
        })
    }

    /// Sets the desired goals in the observations of all environments, (E, O), to those that their
    /// policies pursue.
    pub(crate) fn pursue(&mut self, observations: &mut [f32]) {
        let len = self.rule.goal_len;
        let rows = observations.chunks_exact_mut(observations.len() / self.has_goal.len());
        for (env, row) in rows.enumerate() {
            let place = env * len..(env + 1) * len;
            if !self.has_goal[env] {
                self.has_goal[env] = true;
                self.pursued[place.clone()].copy_from_slice(self.rule.desired(row));
                self.remember(place.start);
            }
            let goal = &mut self.pursued[place];
            let is_reached = self.rule.distance(self.rule.achieved(row), goal) <= self.threshold;
            if is_reached && self.random.random_bool(self.probability) {
                let drawn = self.random.random_range(0..self.known.len() / len);
                goal.copy_from_slice(&self.known[drawn * len..(drawn + 1) * len]);
            }
            self.rule.set_desired(row, goal);
        }
    }

    /// Adds the goal at `from` in `pursued` to the known ones, in place of the oldest.
    fn remember(&mut self, from: usize) {
        let (len, goal) = (self.rule.goal_len, from..from + self.rule.goal_len);
        if self.known.len() < KNOWN_MAX * len {
            self.known.extend_from_slice(&self.pursued[goal]);
        } else {
            let oldest = self.episodes % KNOWN_MAX * len;
            self.known[oldest..oldest + len].copy_from_slice(&self.pursued[goal]);
        }
        self.episodes += 1;
    }

    /// Tells that environment `env` starts a new episode.
    pub(crate) fn episode_ended(&mut self, env: usize) {
        self.has_goal[env] = false;
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::{Layers, Limits};
    use dmprl_shared::goal_rule::Norm;
    use dmprl_shared::seeds;

    use super::*;

    /// Observations are (achieved goal, desired goal), with one number each.
    fn switching(probability: &str) -> Option<GoalSwitching> {
        let reward = GoalReward::Sparse { threshold: 0.5, reached: 0.0, missed: -1.0 };
        let (components, norm) = (vec![0], Norm::Euclidean);
        let (achieved, desired, goal_len, ends_within) = (0, 1, 1, None);
        let rule = GoalRule { achieved, desired, goal_len, components, norm, reward, ends_within };
        let mut layers = Layers::new();
        layers.set("test", "exploration.goal_switches", probability).unwrap();
        layers.set("test", "replay.hindsight", "future").unwrap();
        layers.set("test", "actors.envs_per_worker", "2").unwrap();
        layers.set("test", "policy.start", "zero").unwrap();
        let config = layers.finish().unwrap().resolve(Limits { cores: 1 }).unwrap();
        GoalSwitching::new(Some(&rule), &config, seeds::stream(1, "test", 0))
    }

    /// Returns the goals that both policies see, after a decision at these achieved goals.
    fn goals(switching: &mut GoalSwitching, achieved: [f32; 2], desired: [f32; 2]) -> [f32; 2] {
        let mut observations = [achieved[0], desired[0], achieved[1], desired[1]];
        switching.pursue(&mut observations);
        assert_eq!([observations[0], observations[2]], achieved);
        [observations[1], observations[3]]
    }

    #[test]
    fn a_policy_pursues_its_own_goal_until_it_reaches_it_and_then_a_known_one() {
        assert!(switching("0.0").is_none());
        let mut switching = switching("1.0").unwrap();
        assert_eq!(goals(&mut switching, [0.0, 0.0], [4.0, 7.0]), [4.0, 7.0]);
        // The first environment reaches its goal. Draws of its own one are allowed.
        let mut seen = Vec::new();
        while !seen.contains(&7.0) {
            assert!(seen.len() < 100, "{seen:?}");
            let [first, second] = goals(&mut switching, [4.4, 0.0], [4.0, 7.0]);
            assert!([4.0, 7.0].contains(&first) && second == 7.0, "{first} {second}");
            seen.push(first);
        }
        // It keeps the other goal although it is at its own one, until the episode ends.
        assert_eq!(goals(&mut switching, [4.0, 0.0], [4.0, 7.0]), [7.0, 7.0]);
        switching.episode_ended(0);
        assert_eq!(goals(&mut switching, [0.0, 0.0], [5.0, 7.0]), [5.0, 7.0]);
        assert_eq!(switching.known, [4.0, 7.0, 5.0]);
    }

    #[test]
    fn the_goals_of_the_oldest_episodes_are_forgotten() {
        let mut switching = switching("1.0").unwrap();
        for episode in 0..300 {
            let goal = episode as f32 + 10.0;
            assert_eq!(goals(&mut switching, [0.0, 0.0], [goal, -5.0]), [goal, -5.0]);
            switching.episode_ended(0);
        }
        assert_eq!(switching.known.len(), KNOWN_MAX);
        // 301 goals: 300 of the first environment, one of the second.
        assert!(switching.known.iter().all(|&goal| goal >= 300.0 + 10.0 - 256.0));
    }
}
