//! A batch of windows, sampled directly into the buffers that the update reads.

use dmprl_shared::config::{AlgorithmConfig, AlgorithmName, CriticInput, Target};
use dmprl_shared::goal_rule::GoalRule;
use dmprl_shared::policy::Policy;
use rand::RngExt;
use rand_distr::StandardNormal;
use thiserror::Error;

use super::outcome_shape::OutcomeShape;
use super::sample::{Sample, SampleSource, target_range};
use crate::replay::{Goal, Replay};

/// The replay has no window to learn from.
#[derive(Debug, Error)]
#[error(
    "the replay holds {segments} segments but no window of {steps} steps; episodes that a time \
     limit ends earlier cannot be used: lower policy.segment_steps"
)]
pub struct NoWindow {
    /// Segments in the replay.
    pub segments: usize,
    /// Steps of a window, K.
    pub steps: usize,
}

/// Sizes of a batch and of the critic's input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BatchShape {
    /// Rows of the batch, B.
    pub rows: usize,
    /// Length O of an observation, including the state (y, yd) if the policy has one.
    pub observation_len: usize,
    /// Numbers of the actions that the critic sees: A times K or 1.
    pub actions_len: usize,
    /// Length of (y_K, yd_K/omega), which follows the actions if the DMP state is carried: 2A or 0.
    pub end_state_len: usize,
    /// Numbers of a whole segment's actions, K A.
    pub segment_actions_len: usize,
    /// Length A of an action.
    pub action_len: usize,
    /// Whether the target needs noise (TD3, SAC and TQC).
    pub next_noise: bool,
    /// Whether the actor's step needs noise (SAC and TQC).
    pub noise: bool,
    /// Shape of the outcome model, if the critics see one.
    pub outcome: Option<OutcomeShape>,
}

impl BatchShape {
    /// Derives the sizes from algorithm, policy and the environment's rule for goals.
    #[must_use]
    pub fn new(config: &AlgorithmConfig, policy: &Policy, rule: Option<&GoalRule>) -> Self {
        let layout = policy.layout();
        let segment_actions_len = layout.segment_steps * layout.action_len;
        let carried = if policy.carries_dmp_state() { 2 * layout.action_len } else { 0 };
        let whole = config.critic == CriticInput::Segment;
        Self {
            rows: config.batch_size,
            observation_len: layout.observation_len,
            actions_len: if whole { segment_actions_len } else { layout.action_len },
            // A critic of the first action only does not evaluate the rest of the segment.
            end_state_len: if whole { carried } else { 0 },
            segment_actions_len,
            action_len: layout.action_len,
            next_noise: config.name == AlgorithmName::Td3 || config.name.has_gaussian_policy(),
            noise: config.name.has_gaussian_policy(),
            outcome: rule
                .filter(|_| config.outcome_model && whole)
                .and_then(|rule| OutcomeShape::new(rule, layout.segment_steps)),
        }
    }

    /// Returns the width of a batch's critic inputs: observation, actions, end state.
    #[must_use]
    pub fn critic_inputs(&self) -> usize {
        self.observation_len + self.actions_len + self.end_state_len
    }

    /// Returns the width of the critic's input: a batch's, then the outcome model's features.
    #[must_use]
    pub fn critic_width(&self) -> usize {
        self.critic_inputs() + self.outcome.map_or(0, OutcomeShape::features_len)
    }
}

/// A sampled batch.
#[derive(Debug)]
pub struct Batch {
    /// s_t in the units of environment and DMP, (B, O).
    pub observations: Vec<f32>,
    /// s_t as network input, normalised if configured, (B, O).
    pub inputs: Vec<f32>,
    /// Critic inputs: s_t as network input, actions, end state, (B, critic inputs).
    pub critic_inputs: Vec<f32>,
    /// Sum of the window's rewards, discounted if the target is `n_step`, (B,).
    pub rewards: Vec<f32>,
    /// Factor of Q' in the target, 0 where the episode terminated, (B,).
    pub bootstrap: Vec<f32>,
    /// Observation from which the target bootstraps, (B, O).
    pub next_observations: Vec<f32>,
    /// The same observation as network input, (B, O).
    pub next_inputs: Vec<f32>,
    /// Standard normal noise for the actions after the window, (B, K A), or empty.
    pub next_noise: Vec<f32>,
    /// Standard normal noise for the actor's own actions, (B, K A), or empty.
    pub noise: Vec<f32>,
    /// u_{t-2} and u_{t-1}, (B, 2, A), if they exist. Filled only with a penalty on their changes.
    pub previous_actions: Vec<f32>,
    /// 1 if u_{t-2}, and u_{t-1}, exist, 0 if the episode began later or the replay no longer has
    /// them, (B, 2). The second is 1 where the first is.
    pub has_previous: Vec<f32>,
    /// 1 if the window led to its goal, else 0, (B,). Filled only with a penalty on imitation.
    pub led_to_goal: Vec<f32>,
    /// How each step of the window moves the achieved goal, for the outcome model, (B, K G).
    pub motion: Vec<f32>,
    /// Smallest and largest target that the rewards allow; infinite if unknown.
    pub target_range: [f32; 2],
    actions: Vec<f32>,
    /// The goal of a row, where no observation has it.
    goal: Vec<f32>,
}

/// The same states in the units of the DMP and as network inputs, (B, O) each.
#[derive(Debug, Clone, Copy)]
pub struct States<'a> {
    /// In the units of environment and DMP.
    pub observations: &'a [f32],
    /// As network inputs, normalised if configured.
    pub inputs: &'a [f32],
}

impl Batch {
    /// Returns the states s_t.
    #[must_use]
    pub fn states(&self) -> States<'_> {
        States { observations: &self.observations, inputs: &self.inputs }
    }

    /// Returns the actions that led to the goal of a row, (K, A), if they did.
    #[must_use]
    pub fn imitated(&self, shape: BatchShape, row: usize) -> Option<&[f32]> {
        let first = row * shape.critic_inputs() + shape.observation_len;
        (self.led_to_goal[row] > 0.0).then(|| &self.critic_inputs[first..][..shape.actions_len])
    }

    /// Returns the states from which the target bootstraps.
    #[must_use]
    pub fn next_states(&self) -> States<'_> {
        States { observations: &self.next_observations, inputs: &self.next_inputs }
    }

    /// Allocates the buffers of one batch.
    #[must_use]
    pub fn new(shape: BatchShape) -> Self {
        let actions_len = shape.rows * shape.segment_actions_len;
        let noise = |used: bool| vec![0.0; if used { actions_len } else { 0 }];
        Self {
            observations: vec![0.0; shape.rows * shape.observation_len],
            inputs: vec![0.0; shape.rows * shape.observation_len],
            critic_inputs: vec![0.0; shape.rows * shape.critic_inputs()],
            rewards: vec![0.0; shape.rows],
            bootstrap: vec![0.0; shape.rows],
            next_observations: vec![0.0; shape.rows * shape.observation_len],
            next_inputs: vec![0.0; shape.rows * shape.observation_len],
            next_noise: noise(shape.next_noise),
            noise: noise(shape.noise),
            previous_actions: vec![0.0; shape.rows * 2 * shape.action_len],
            has_previous: vec![0.0; shape.rows * 2],
            led_to_goal: vec![0.0; shape.rows],
            motion: vec![0.0; shape.rows * shape.outcome.map_or(0, OutcomeShape::outputs)],
            target_range: [f32::NEG_INFINITY, f32::INFINITY],
            actions: vec![0.0; shape.segment_actions_len],
            goal: Vec::new(),
        }
    }

    /// Samples windows into the batch. `omega` is the DMP's.
    ///
    /// With target `n_step`, rewards are discounted per step and bootstrap is discount^n (1 -
    /// terminated) from s_{t+n}. With `literal`, rewards are summed without discount and bootstrap
    /// is discount (1 - terminated) from s_{t+1}. A truncated episode bootstraps like any other
    /// step.
    ///
    /// # Errors
    /// [`NoWindow`] if there is nothing to sample.
    pub fn sample(
        &mut self,
        shape: BatchShape,
        config: &AlgorithmConfig,
        omega: f32,
        source: &mut SampleSource<'_>,
    ) -> Result<(), NoWindow> {
        let (replay, normaliser) = (source.replay, source.normaliser);
        let mut goal = std::mem::take(&mut self.goal);
        for row in 0..shape.rows {
            let sample = Sample::draw(source, &mut goal)
                .ok_or(NoWindow { segments: replay.len(), steps: replay.layout().segment_steps })?;
            self.write_states(shape, row, replay, &sample, config);
            let (o, width) = (shape.observation_len, shape.critic_inputs());
            let observation = &self.observations[row * o..(row + 1) * o];
            let input = &mut self.critic_inputs[row * width..(row + 1) * width];
            match normaliser {
                Some(normaliser) => normaliser.apply_row(observation, &mut input[..o]),
                None => input[..o].copy_from_slice(observation),
            }
            self.inputs[row * o..(row + 1) * o].copy_from_slice(&input[..o]);
            self.write_actions(shape, row, replay, &sample, config);
            if shape.end_state_len > 0 {
                // The carried state is the end of the observation after the window.
                let dims = shape.end_state_len / 2;
                let last = replay.observation_after(&sample.window, sample.outcome.steps);
                let end = &mut self.critic_inputs[row * width..][o + shape.actions_len..width];
                end.copy_from_slice(&last[o - 2 * dims..]);
                end[dims..].iter_mut().for_each(|velocity| *velocity /= omega);
            }
        }
        self.goal = goal;
        match normaliser {
            Some(normaliser) => normaliser.apply(&self.next_observations, &mut self.next_inputs),
            None => self.next_inputs.copy_from_slice(&self.next_observations),
        }
        for value in self.next_noise.iter_mut().chain(&mut self.noise) {
            *value = source.sampler.random_mut().sample(StandardNormal);
        }
        self.target_range = target_range(source.hindsight, config);
        Ok(())
    }

    /// Writes reward, bootstrap and both observations of a row.
    fn write_states(
        &mut self,
        shape: BatchShape,
        row: usize,
        replay: &Replay,
        sample: &Sample<'_>,
        config: &AlgorithmConfig,
    ) {
        let Sample { window, outcome, goal, .. } = sample;
        let discount = config.discount as f32;
        let (rewards_discount, factor, next) = match config.target {
            Target::NStep => (
                discount,
                discount.powi(outcome.steps as i32),
                replay.observation_after(window, outcome.steps),
            ),
            Target::Literal => (1.0, discount, replay.second_observation(window)),
        };
        let o = shape.observation_len;
        let rows = row * o..(row + 1) * o;
        self.observations[rows.clone()].copy_from_slice(replay.observation(window));
        self.next_observations[rows.clone()].copy_from_slice(next);
        if let Some(Goal { rule, values }) = *goal {
            rule.set_desired(&mut self.observations[rows.clone()], values);
            rule.set_desired(&mut self.next_observations[rows], values);
        }
        self.rewards[row] = sample.discounted_reward(replay, rewards_discount);
        self.bootstrap[row] = if outcome.terminated { 0.0 } else { factor };
        if let Some(reward) = sample.reward_after(replay, config) {
            self.rewards[row] += factor * reward;
            self.bootstrap[row] = 0.0;
        }
        if let Some(shape) = shape.outcome {
            let own = row * shape.outputs()..(row + 1) * shape.outputs();
            shape.write_motion(replay, window, *outcome, &mut self.motion[own]);
        }
    }

    /// Writes the actions of a row, and the action before them.
    fn write_actions(
        &mut self,
        shape: BatchShape,
        row: usize,
        replay: &Replay,
        sample: &Sample<'_>,
        config: &AlgorithmConfig,
    ) {
        let Sample { window, outcome, .. } = sample;
        replay.actions(window, &mut self.actions);
        self.actions[outcome.steps * shape.action_len..].fill(0.0);
        let first = row * shape.critic_inputs() + shape.observation_len;
        self.critic_inputs[first..first + shape.actions_len]
            .copy_from_slice(&self.actions[..shape.actions_len]);
        if config.imitates() {
            self.led_to_goal[row] = f32::from(u8::from(sample.led_to_goal(replay)));
        }
        if config.action_rate_penalty + config.action_acceleration_penalty > 0.0 {
            for (index, previous) in replay.previous_actions(window).into_iter().enumerate() {
                let at = 2 * row + index;
                self.has_previous[at] = f32::from(u8::from(previous.is_some()));
                let out = self.previous_actions.chunks_exact_mut(shape.action_len).nth(at);
                previous.zip(out).into_iter().for_each(|(from, out)| out.copy_from_slice(from));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Windows;
    use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TERMINATED, TRUNCATED};

    use super::*;
    use crate::normaliser::Normaliser;
    use crate::replay::Sampler;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 2, observation_len: 1, action_len: 1 };
    const SHAPE: BatchShape = BatchShape {
        rows: 64,
        observation_len: 1,
        actions_len: 2,
        end_state_len: 0,
        segment_actions_len: 2,
        action_len: 1,
        next_noise: false,
        noise: false,
        outcome: None,
    };

    /// Inserts an episode e of three steps: s_t = 10 e + t, u_t = (t + 1) / 10, r_t = 1, 10, 100.
    fn episode(replay: &mut Replay, episode: u32, flag: u32) {
        let first = 10.0 * episode as f32;
        let whole = [first, first + 1.0, first + 2.0, 0.1, 0.2, 1.0, 10.0];
        let rest = [first + 2.0, first + 3.0, 0.0, 0.3, 0.0, 100.0, 0.0];
        for (block, episode_step, steps_len, flags) in [(whole, 0, 2, 0), (rest, 2, 1, flag)] {
            let header = SegmentHeader {
                episode,
                episode_step,
                steps_len,
                flags,
                ..SegmentHeader::default()
            };
            replay.insert(&header, &block);
        }
    }

    /// (s_t, actions of the window, reward, bootstrap, state to bootstrap from).
    type Row = (f32, [f32; 2], f32, f32, f32);

    fn source<'a>(replay: &'a Replay, sampler: &'a mut Sampler) -> SampleSource<'a> {
        SampleSource { replay, sampler, hindsight: None, jerk_cost: None, normaliser: None }
    }

    /// Returns the distinct rows of a batch.
    fn rows(replay: &Replay, windows: Windows, target: Target) -> Vec<Row> {
        let config = AlgorithmConfig { target, discount: 0.5, ..AlgorithmConfig::default() };
        let mut sampler = Sampler::new(windows, dmprl_shared::seeds::stream(1, "test", 0));
        let mut batch = Batch::new(SHAPE);
        let mut source = source(replay, &mut sampler);
        batch.sample(SHAPE, &config, 1.0, &mut source).unwrap();
        let mut rows: Vec<Row> = (0..SHAPE.rows)
            .map(|row| {
                let input = &batch.critic_inputs[3 * row..3 * row + 3];
                assert_eq!(input[0], batch.observations[row]);
                let (reward, factor) = (batch.rewards[row], batch.bootstrap[row]);
                (input[0], [input[1], input[2]], reward, factor, batch.next_observations[row])
            })
            .collect();
        rows.sort_by(|a, b| a.0.total_cmp(&b.0));
        rows.dedup();
        rows
    }

    fn replay(slots: usize, episodes: &[(u32, u32)]) -> Replay {
        let mut replay = Replay::new(LAYOUT, 2 * slots, 1, 1);
        episodes.iter().for_each(|&(number, flag)| episode(&mut replay, number, flag));
        replay
    }

    #[test]
    fn n_step_targets_of_a_terminated_episode_are_those_worked_by_hand() {
        let expected = [
            (0.0, [0.1, 0.2], 6.0, 0.25, 2.0),
            (1.0, [0.2, 0.3], 60.0, 0.0, 3.0),
            (2.0, [0.3, 0.0], 100.0, 0.0, 3.0),
        ];
        assert_eq!(rows(&replay(9, &[(0, TERMINATED)]), Windows::Sliding, Target::NStep), expected);
    }

    #[test]
    fn n_step_targets_of_a_truncated_episode_bootstrap_and_leave_the_short_window_out() {
        let expected = [(0.0, [0.1, 0.2], 6.0, 0.25, 2.0), (1.0, [0.2, 0.3], 60.0, 0.25, 3.0)];
        assert_eq!(rows(&replay(9, &[(0, TRUNCATED)]), Windows::Sliding, Target::NStep), expected);
    }

    #[test]
    fn segment_windows_begin_at_decisions_only() {
        let expected = [(0.0, [0.1, 0.2], 6.0, 0.25, 2.0), (2.0, [0.3, 0.0], 100.0, 0.0, 3.0)];
        assert_eq!(rows(&replay(9, &[(0, TERMINATED)]), Windows::Segment, Target::NStep), expected);
    }

    #[test]
    fn literal_targets_sum_plainly_and_bootstrap_from_the_second_observation() {
        let expected = [(0.0, [0.1, 0.2], 11.0, 0.5, 1.0), (2.0, [0.3, 0.0], 100.0, 0.0, 3.0)];
        let replay = replay(9, &[(0, TERMINATED)]);
        assert_eq!(rows(&replay, Windows::Segment, Target::Literal), expected);
    }

    #[test]
    fn a_wrapped_ring_learns_from_what_it_holds_and_mixes_no_episodes() {
        // With three slots, the second episode replaces the whole segment of the first.
        let replay = replay(3, &[(0, TERMINATED), (1, TRUNCATED)]);
        let expected = [
            (2.0, [0.3, 0.0], 100.0, 0.0, 3.0),
            (10.0, [0.1, 0.2], 6.0, 0.25, 12.0),
            (11.0, [0.2, 0.3], 60.0, 0.25, 13.0),
        ];
        assert_eq!(rows(&replay, Windows::Sliding, Target::NStep), expected);
    }

    #[test]
    fn a_price_on_changes_asks_for_the_actions_before_the_windows() {
        let config = AlgorithmConfig { action_acceleration_penalty: 1.0, ..Default::default() };
        let replay = replay(9, &[(0, TERMINATED)]);
        let mut sampler = Sampler::new(Windows::Sliding, dmprl_shared::seeds::stream(1, "test", 0));
        let mut batch = Batch::new(SHAPE);
        let mut source = source(&replay, &mut sampler);
        batch.sample(SHAPE, &config, 1.0, &mut source).unwrap();
        let mut seen = [false; 3];
        for row in 0..SHAPE.rows {
            let step = batch.observations[row] as usize;
            for (before, at) in [(2, 2 * row), (1, 2 * row + 1)] {
                let expected = if step < before { 0.0 } else { 0.1 * (step + 1 - before) as f32 };
                assert_eq!(batch.has_previous[at] * batch.previous_actions[at], expected);
                assert_eq!(batch.has_previous[at], f32::from(u8::from(step >= before)));
            }
            seen[step] = true;
        }
        assert_eq!(seen, [true; 3]);
    }

    #[test]
    fn networks_see_normalised_observations_and_the_dmp_plain_ones() {
        let mut normaliser = Normaliser::new(1, 1, None);
        normaliser.observe(&[-1.0, 3.0]); // mean 1, standard deviation 2
        normaliser.update();
        let replay = replay(9, &[(0, TERMINATED)]);
        let mut sampler = Sampler::new(Windows::Segment, dmprl_shared::seeds::stream(1, "test", 0));
        let mut batch = Batch::new(SHAPE);
        let config = AlgorithmConfig::default();
        let normaliser = Some(&normaliser);
        let mut source = SampleSource { normaliser, ..source(&replay, &mut sampler) };
        batch.sample(SHAPE, &config, 1.0, &mut source).unwrap();
        assert!(batch.observations.contains(&0.0) && batch.observations.contains(&2.0));
        for row in 0..SHAPE.rows {
            let (s, next) = (batch.observations[row], batch.next_observations[row]);
            assert_eq!(batch.inputs[row], (s - 1.0) / 2.0);
            assert_eq!(batch.critic_inputs[3 * row], batch.inputs[row]);
            assert_eq!(batch.next_inputs[row], (next - 1.0) / 2.0);
        }
    }

    #[test]
    fn a_carried_state_is_the_tail_of_the_observation_after_the_window_in_the_dmps_time() {
        // Observation t is (t, y = t / 8, yd = 4 t); omega = 2.
        let layout = SegmentLayout { observation_len: 3, ..LAYOUT };
        let shape = BatchShape { observation_len: 3, end_state_len: 2, ..SHAPE };
        let mut replay = Replay::new(layout, 18, 1, 1);
        for (episode_step, steps_len, flags) in [(0_u32, 2_u32, 0), (2, 1, TERMINATED)] {
            let mut block = vec![0.0; layout.block_len()];
            let (observations, actions, _) = layout.split_mut(&mut block);
            for k in 0..=steps_len as usize {
                let t = (episode_step as usize + k) as f32;
                observations[3 * k..3 * k + 3].copy_from_slice(&[t, t / 8.0, 4.0 * t]);
            }
            actions.fill(0.5);
            let header = SegmentHeader { episode_step, steps_len, flags, ..Default::default() };
            replay.insert(&header, &block);
        }
        let random = dmprl_shared::seeds::stream(1, "test", 0);
        let mut sampler = Sampler::new(Windows::Sliding, random);
        let mut batch = Batch::new(shape);
        let config = AlgorithmConfig::default();
        let mut source = source(&replay, &mut sampler);
        batch.sample(shape, &config, 2.0, &mut source).unwrap();
        let mut ends = [None; 3];
        for input in batch.critic_inputs.chunks_exact(7) {
            ends[input[0] as usize] = Some([input[5], input[6]]);
        }
        // From step 1 the window continues in the next slot; from step 2 it is short.
        assert_eq!(ends, [Some([0.25, 4.0]), Some([0.375, 6.0]), Some([0.375, 6.0])]);
    }
}
