//! Stage 5 of 8 for on-policy algorithms: stores the segments of one policy, instead of the replay,
//! and estimates their advantages.
//!
//! Each segment is one entry. The segments of many environments arrive interleaved. An entry refers
//! to the one that continues its episode, so that advantages follow each environment's own chain.

use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TERMINATED, TRUNCATED};

/// The newest segment of one environment.
#[derive(Debug, Clone, Copy)]
struct Tail {
    entry: usize,
    incarnation: u32,
    episode: u32,
    /// Steps of the episode until the end of the segment.
    episode_steps: u32,
}

/// Up to N segments with their rewards, values and advantages.
#[derive(Debug)]
pub struct RolloutBuffer {
    layout: SegmentLayout,
    discount: f32,
    envs_per_worker: usize,
    capacity: usize,
    /// Observation on which each segment was decided, (N, O).
    pub observations: Vec<f32>,
    /// Observation after each segment's last step, (N, O).
    pub last_observations: Vec<f32>,
    /// Actions as drawn, (N, K, A); zero after a segment's last step.
    pub actions: Vec<f32>,
    /// Steps that were run, (N,).
    pub steps_len: Vec<usize>,
    /// Sum of discount^i r_i over a segment's steps, (N,).
    rewards: Vec<f32>,
    /// Factor of the value after the segment, discount^steps (1 - terminated), (N,).
    bootstrap: Vec<f32>,
    /// Entry that continues the episode, (N,).
    next: Vec<Option<usize>>,
    /// V of `observations`, (N,); the caller fills it before [`RolloutBuffer::estimate`].
    pub values: Vec<f32>,
    /// V of `last_observations`, (N,); the caller fills it before [`RolloutBuffer::estimate`].
    pub last_values: Vec<f32>,
    /// Advantage of each segment, (N,), scaled to mean 0 and deviation 1.
    pub advantages: Vec<f32>,
    /// Targets of the value, (N,).
    pub returns: Vec<f32>,
    tails: Vec<Option<Tail>>,
}

/// Sizes and discount of a rollout buffer.
#[derive(Debug, Clone, Copy)]
pub struct RolloutShape {
    /// Sizes of a segment.
    pub layout: SegmentLayout,
    /// Segments of a rollout, N.
    pub segments: usize,
    /// Discount per environment step.
    pub discount: f32,
    /// Workers of the run.
    pub workers: usize,
    /// Environments per worker.
    pub envs_per_worker: usize,
}

impl RolloutBuffer {
    /// Makes an empty buffer.
    #[must_use]
    pub fn new(shape: RolloutShape) -> Self {
        let RolloutShape { layout, segments, discount, workers, envs_per_worker } = shape;
        let rows = |width: usize| vec![0.0; segments * width];
        Self {
            layout,
            discount,
            envs_per_worker,
            capacity: segments,
            observations: rows(layout.observation_len),
            last_observations: rows(layout.observation_len),
            actions: rows(layout.actions_len()),
            steps_len: Vec::with_capacity(segments),
            rewards: rows(1),
            bootstrap: rows(1),
            next: vec![None; segments],
            values: rows(1),
            last_values: rows(1),
            advantages: rows(1),
            returns: rows(1),
            tails: vec![None; workers * envs_per_worker],
        }
    }

    /// Returns the number of segments.
    #[must_use]
    pub fn len(&self) -> usize {
        self.steps_len.len()
    }

    /// Returns whether the buffer has no segments.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.steps_len.is_empty()
    }

    /// Returns whether the rollout is complete.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.len() == self.capacity
    }

    /// Removes all segments.
    pub fn clear(&mut self) {
        self.steps_len.clear();
        self.next.fill(None);
        self.tails.fill(None);
    }

    /// Inserts a segment that has passed `segment::check`.
    ///
    /// # Panics
    /// If the buffer is full.
    pub fn insert(&mut self, header: &SegmentHeader, block: &[f32]) {
        assert!(!self.is_full(), "a rollout takes {} segments", self.capacity);
        let entry = self.len();
        let steps = header.steps_len as usize;
        let (o, a) = (self.layout.observation_len, self.layout.actions_len());
        let (observations, actions, rewards) = self.layout.split(block);
        self.observations[entry * o..(entry + 1) * o].copy_from_slice(&observations[..o]);
        self.last_observations[entry * o..(entry + 1) * o]
            .copy_from_slice(&observations[steps * o..(steps + 1) * o]);
        self.actions[entry * a..(entry + 1) * a].copy_from_slice(actions);
        let discounted = |sum: f32, reward: &f32| reward + self.discount * sum;
        self.rewards[entry] = rewards[..steps].iter().rev().fold(0.0, discounted);
        let terminated = header.flags & TERMINATED != 0;
        self.bootstrap[entry] =
            if terminated { 0.0 } else { self.discount.powi(header.steps_len as i32) };
        self.steps_len.push(steps);
        self.link(header, entry);
    }

    /// Links a segment to its predecessor. A gap in an episode, from a lost segment or a restarted
    /// worker, is never bridged: the chain ends there with the value of its last observation, like
    /// an unfinished episode.
    fn link(&mut self, header: &SegmentHeader, entry: usize) {
        let env = header.worker_id as usize * self.envs_per_worker + header.env_index as usize;
        if let Some(tail) = self.tails[env]
            && tail.incarnation == header.incarnation
            && tail.episode == header.episode
            && tail.episode_steps == header.episode_step
        {
            self.next[tail.entry] = Some(entry);
        }
        let ended = header.flags & (TERMINATED | TRUNCATED) != 0;
        self.tails[env] = (!ended).then_some(Tail {
            entry,
            incarnation: header.incarnation,
            episode: header.episode,
            episode_steps: header.episode_step + header.steps_len,
        });
    }

    /// Estimates advantages over segments from `values` and `last_values` (generalised advantage
    /// estimation, Schulman et al. 2016, equation 16).
    ///     delta_i = reward_i + bootstrap_i V(last_i) - V_i
    ///     advantage_i = delta_i + bootstrap_i lambda advantage_{next of i}
    /// Sets `returns` to advantage + value, then scales `advantages` to mean 0 and deviation 1.
    pub fn estimate(&mut self, lambda: f32) {
        // Backwards, because an entry that continues another has a higher index.
        for entry in (0..self.len()).rev() {
            let bootstrap = self.bootstrap[entry];
            let delta =
                self.rewards[entry] + bootstrap * self.last_values[entry] - self.values[entry];
            let next = self.next[entry].map_or(0.0, |next| self.advantages[next]);
            self.advantages[entry] = delta + bootstrap * lambda * next;
            self.returns[entry] = self.advantages[entry] + self.values[entry];
        }
        let len = self.len();
        normalise(&mut self.advantages[..len]);
    }
}

/// Added to the deviation, so that equal advantages become zero instead of infinite.
const DEVIATION_MIN: f64 = 1e-5;

fn normalise(values: &mut [f32]) {
    let len = values.len() as f64;
    let mean = values.iter().map(|value| f64::from(*value)).sum::<f64>() / len;
    let squares = values.iter().map(|value| (f64::from(*value) - mean).powi(2)).sum::<f64>();
    // A single segment has no deviation.
    let deviation = (squares / (len - 1.0).max(1.0)).sqrt() + DEVIATION_MIN;
    for value in values {
        *value = ((f64::from(*value) - mean) / deviation) as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 2, observation_len: 1, action_len: 1 };

    fn buffer(segments: usize) -> RolloutBuffer {
        RolloutBuffer::new(RolloutShape {
            layout: LAYOUT,
            segments,
            discount: 0.5,
            workers: 1,
            envs_per_worker: 2,
        })
    }

    /// Inserts segment `number` of an episode with two rewards. Its last observation is its number.
    fn insert(buffer: &mut RolloutBuffer, number: u32, rewards: [f32; 2], flags: u32) {
        let header = SegmentHeader {
            steps_len: 2,
            episode_step: 2 * number,
            flags,
            ..SegmentHeader::default()
        };
        let last = number as f32;
        buffer.insert(&header, &[0.0, 0.0, last, 0.0, 0.0, rewards[0], rewards[1]]);
    }

    /// Returns the advantages of three segments with lambda = 0.5, and V = 1 except 8 after the
    /// third segment. With discount 0.5 a segment's reward is r_0 + r_1 / 2 and its bootstrap 1/4.
    ///
    /// The rewards (1, 2), (0, 4), (2, 2) give the deltas 2 + 1/4 - 1 = 1.25, 2 + 1/4 - 1 = 1.25
    /// and, for the third, 3 + 8/4 - 1 = 4 or, if it terminated, 3 - 1 = 2. The third advantage is
    /// its delta, the second 1.25 + 1/8 of the third, the first 1.25 + 1/8 of the second.
    fn advantages_of_three(flags: u32) -> [f32; 3] {
        let mut buffer = buffer(3);
        for (number, rewards) in [[1.0, 2.0], [0.0, 4.0], [2.0, 2.0]].into_iter().enumerate() {
            let last = number == 2;
            insert(&mut buffer, number as u32, rewards, if last { flags } else { 0 });
        }
        buffer.values.fill(1.0);
        buffer.last_values.copy_from_slice(&[1.0, 1.0, 8.0]);
        buffer.estimate(0.5);
        std::array::from_fn(|entry| buffer.returns[entry] - 1.0)
    }

    #[test]
    fn a_truncated_or_unfinished_episode_is_worth_its_last_value() {
        let expected = [1.25 + 1.75 / 8.0, 1.75, 4.0];
        assert_eq!(advantages_of_three(TRUNCATED), expected);
        assert_eq!(advantages_of_three(0), expected);
    }

    #[test]
    fn a_terminated_episode_is_worth_no_value_after_it() {
        assert_eq!(advantages_of_three(TERMINATED), [1.25 + 1.5 / 8.0, 1.5, 2.0]);
    }

    #[test]
    fn a_gap_of_stale_segments_ends_the_chain_with_the_value_before_it() {
        let mut buffer = buffer(2);
        insert(&mut buffer, 0, [1.0, 2.0], 0);
        // The second segment came from another policy.
        insert(&mut buffer, 2, [2.0, 2.0], 0);
        buffer.values.fill(1.0);
        buffer.last_values.copy_from_slice(&[1.0, 8.0]);
        buffer.estimate(0.5);
        assert_eq!(buffer.returns, [2.25, 5.0]);
    }

    #[test]
    fn the_next_episode_and_another_environment_continue_nothing() {
        for change in [
            |header: &mut SegmentHeader| header.episode = 1,
            |header: &mut SegmentHeader| header.env_index = 1,
            |header: &mut SegmentHeader| header.incarnation = 1,
        ] {
            let mut buffer = buffer(2);
            insert(&mut buffer, 0, [0.0; 2], 0);
            let mut header =
                SegmentHeader { steps_len: 2, episode_step: 2, ..SegmentHeader::default() };
            change(&mut header);
            buffer.insert(&header, &[0.0, 0.0, 0.0, 0.0, 0.0, 100.0, 0.0]);
            buffer.estimate(1.0);
            assert_eq!(buffer.returns, [0.0, 100.0]);
        }
    }

    #[test]
    fn a_segment_cut_short_keeps_its_last_observation_and_discounts_by_its_steps() {
        let mut buffer = buffer(1);
        let header = SegmentHeader { steps_len: 1, flags: TRUNCATED, ..SegmentHeader::default() };
        buffer.insert(&header, &[3.0, 7.0, 0.0, 0.5, 0.0, 1.0, 0.0]);
        assert_eq!((buffer.observations[0], buffer.last_observations[0]), (3.0, 7.0));
        buffer.last_values[0] = 4.0;
        buffer.estimate(0.5);
        assert_eq!(buffer.returns, [1.0 + 4.0 / 2.0]);
        assert!(buffer.is_full());
        buffer.clear();
        assert!(buffer.is_empty());
    }

    #[test]
    fn advantages_have_mean_zero_and_deviation_one() {
        let mut values = [1.0, 2.0, 3.0];
        normalise(&mut values);
        for (got, expected) in values.iter().zip([-1.0, 0.0, 1.0]) {
            assert!((got - expected).abs() < 1e-4, "{values:?}");
        }
        let mut equal = [7.0; 4];
        normalise(&mut equal);
        assert_eq!(equal, [0.0; 4]);
    }
}
