//! Stage 3 of 8, hindsight: copies an episode's segments with goals that the episode reached
//! (Andrychowicz et al. 2017).
//!
//! Called by the rollout at the end of each episode, for environments whose rewards follow no goal
//! rule (`dmprl_shared::goal_rule`). Only such an environment itself can compute the rewards for
//! another goal, so the worker creates the copies, with one call into Python. A copy is one
//! decision: up to K steps with one goal, which the episode reached in or after these steps. With a
//! rule, the learner draws goals itself.
//!
//! Differences from Andrychowicz et al., Algorithm 1:
//! 1. A goal is drawn for a segment of K steps, not for a step; K = 1 is the published algorithm.
//! 2. With sliding windows, a copy starts at a random step of the segment, but no later than K
//!    steps before the episode's end.
//! 3. A copy ends where the task would have ended the episode at its goal. A copy with fewer than K
//!    steps for another reason is dropped, because a missing action is not a zero action.

use dmprl_shared::config::{ExperimentConfig, Hindsight as Strategy, Windows};
use dmprl_shared::seeds::{self, Stream};
use dmprl_shared::segment::{HINDSIGHT, SegmentLayout, TERMINATED};
use rand::RngExt;

use crate::python_env::{Goals, PythonEnvironments, PythonError, Relabelling};
use crate::rollout::SegmentMeta;

/// Records of the current episodes, and planned copies of the last episode that ended. All buffers
/// are allocated once.
pub(crate) struct Hindsight {
    layout: SegmentLayout,
    goals: Goals,
    strategy: Strategy,
    copies: usize,
    sliding: bool,
    random: Stream,
    /// One episode for each environment.
    episodes: Vec<Episode>,
    /// Planned copies.
    drawn: Vec<Draw>,
    relabelling: Relabelling,
    task_id: String,
}

/// Record of an episode of T steps.
#[derive(Debug)]
struct Episode {
    steps: usize,
    /// Observations of the policy, (T+1, O).
    observations: Vec<f32>,
    /// Actions u, (T, A).
    actions: Vec<f32>,
    /// Achieved goals, (T+1, G), in 64 bits, so that thresholds are compared as in the environment.
    achieved: Vec<f64>,
    segments: Vec<Decision>,
}

/// A segment of an episode: `len` steps from step `first`.
#[derive(Debug, Clone, Copy)]
struct Decision {
    first: usize,
    len: usize,
    policy_version: u64,
}

/// A planned copy: `len` steps from step `first`, with the goal that was achieved in row `goal`.
#[derive(Debug, Clone, Copy)]
struct Draw {
    first: usize,
    len: usize,
    goal: usize,
    policy_version: u64,
    /// Its first row in the call into the environment.
    row: usize,
}

/// A segment to be added to its episode.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EpisodeSegment<'a> {
    /// Number of executed steps, 1 to K.
    pub(crate) steps: usize,
    /// The segment's block.
    pub(crate) block: &'a [f32],
    /// Observations of the environment in 64 bits, (K+1, O without the policy's additions).
    pub(crate) observations: &'a [f64],
    /// Version of the policy that acted.
    pub(crate) policy_version: u64,
}

impl Hindsight {
    /// Creates the records; returns `None` if the configuration disables hindsight or the learner
    /// draws the goals.
    ///
    /// # Errors
    /// `NoGoals` if the environments have no goals, or their episodes have no time limit.
    pub(crate) fn start(
        config: &ExperimentConfig,
        environments: &PythonEnvironments,
        layout: SegmentLayout,
        worker: u64,
    ) -> Result<Option<Self>, PythonError> {
        let has_rule = environments.spec().goal_rule.is_some();
        if config.replay.hindsight == Strategy::None || has_rule {
            return Ok(None);
        }
        let goals = environments.goals()?;
        let spec = environments.spec();
        let steps_max = spec.episode_steps as usize;
        if steps_max == 0 {
            let reason = format!("{}: its episodes have no time limit", spec.id);
            return Err(PythonError::NoGoals { reason });
        }
        let segments_max = steps_max.div_ceil(layout.segment_steps);
        let copies_max = segments_max * config.replay.hindsight_copies;
        let episode = || Episode {
            steps: 0,
            observations: vec![0.0; (steps_max + 1) * layout.observation_len],
            actions: vec![0.0; steps_max * layout.action_len],
            achieved: vec![0.0; (steps_max + 1) * goals.len],
            segments: Vec::with_capacity(segments_max),
        };
        let rows_max = copies_max * layout.segment_steps;
        Ok(Some(Self {
            layout,
            goals,
            strategy: config.replay.hindsight,
            copies: config.replay.hindsight_copies,
            sliding: config.algorithm.windows == Windows::Sliding,
            random: seeds::stream(config.run.seed, "hindsight", worker),
            episodes: (0..config.actors.envs_per_worker).map(|_| episode()).collect(),
            drawn: Vec::with_capacity(copies_max),
            relabelling: environments.relabelling(rows_max, goals.len)?,
            task_id: spec.id.clone(),
        }))
    }

    /// Maximum number of copies of one episode.
    pub(crate) fn copies_max(&self) -> usize {
        self.drawn.capacity()
    }

    /// Adds the last segment of environment `env` to its episode.
    ///
    /// # Errors
    /// `Interface` if the episode is longer than its specified limit.
    pub(crate) fn add(
        &mut self,
        env: usize,
        segment: EpisodeSegment<'_>,
    ) -> Result<(), PythonError> {
        let EpisodeSegment { steps, block, observations, policy_version } = segment;
        let SegmentLayout { observation_len: o, action_len: a, segment_steps } = self.layout;
        let (g, episode) = (self.goals.len, &mut self.episodes[env]);
        let first = episode.steps;
        if (first + steps + 1) * g > episode.achieved.len() {
            return Err(PythonError::Interface {
                task_id: self.task_id.clone(),
                name: "episode_steps",
                reason: format!("an episode is longer, at least {} steps", first + steps),
            });
        }
        let (seen, actions, _) = self.layout.split(block);
        episode.observations[first * o..][..(steps + 1) * o]
            .copy_from_slice(&seen[..(steps + 1) * o]);
        episode.actions[first * a..][..steps * a].copy_from_slice(&actions[..steps * a]);
        let env_len = observations.len() / (segment_steps + 1);
        for (k, row) in observations.chunks_exact(env_len).take(steps + 1).enumerate() {
            episode.achieved[(first + k) * g..][..g]
                .copy_from_slice(&row[self.goals.achieved..][..g]);
        }
        episode.segments.push(Decision { first, len: steps, policy_version });
        episode.steps += steps;
        Ok(())
    }

    /// Plans the copies of environment `env`'s episode, which has ended, computes their rewards and
    /// returns their number.
    ///
    /// # Errors
    /// If the environments cannot compute the rewards.
    pub(crate) fn relabel(&mut self, env: usize) -> Result<usize, PythonError> {
        self.draw(env);
        let (g, episode) = (self.goals.len, &self.episodes[env]);
        let reached = |row: usize| &episode.achieved[row * g..(row + 1) * g];
        for draw in &self.drawn {
            for step in 0..draw.len {
                let after = draw.first + step + 1;
                self.relabelling.set(draw.row + step, reached(after), reached(draw.goal));
            }
        }
        if let Some(last) = self.drawn.last() {
            self.relabelling.run(last.row + last.len)?;
        }
        Ok(self.drawn.len())
    }

    fn draw(&mut self, env: usize) {
        let (episode, steps_max) = (&self.episodes[env], self.layout.segment_steps);
        self.drawn.clear();
        let mut row = 0;
        for segment in &episode.segments {
            for _ in 0..self.copies {
                let mut first = segment.first;
                if self.sliding {
                    first += self.random.random_range(0..segment.len);
                    // The episode's end would truncate a later copy.
                    first = first.min(episode.steps.saturating_sub(steps_max));
                }
                let len = (episode.steps - first).min(steps_max);
                let earliest = match self.strategy {
                    Strategy::Final => episode.steps,
                    Strategy::Episode => 1,
                    _ => first + 1,
                };
                let goal = self.random.random_range(earliest..=episode.steps);
                let policy_version = segment.policy_version;
                self.drawn.push(Draw { first, len, goal, policy_version, row });
                row += len;
            }
        }
    }

    /// Writes copy `index` of environment `env`'s episode into `block`. Returns `None` if the copy
    /// is dropped.
    ///
    /// # Panics
    /// If `index` is not below the number that [`Hindsight::relabel`] returned.
    pub(crate) fn write(&self, env: usize, index: usize, block: &mut [f32]) -> Option<SegmentMeta> {
        let SegmentLayout { segment_steps, observation_len: o, action_len: a } = self.layout;
        let (draw, episode) = (self.drawn[index], &self.episodes[env]);
        let ends = &self.relabelling.terminated()[draw.row..][..draw.len];
        let end = ends.iter().position(|&terminated| terminated != 0);
        let len = end.map_or(draw.len, |last| last + 1);
        if end.is_none() && len < segment_steps {
            return None;
        }
        block.fill(0.0);
        let (observations, actions, rewards) = self.layout.split_mut(block);
        let rows = (len + 1) * o;
        observations[..rows].copy_from_slice(&episode.observations[draw.first * o..][..rows]);
        let goal = &episode.achieved[draw.goal * self.goals.len..][..self.goals.len];
        for observation in observations[..rows].chunks_exact_mut(o) {
            let desired = &mut observation[self.goals.desired..][..self.goals.len];
            desired.iter_mut().zip(goal).for_each(|(wanted, value)| *wanted = *value as f32);
        }
        actions[..len * a].copy_from_slice(&episode.actions[draw.first * a..][..len * a]);
        let from = &self.relabelling.rewards()[draw.row..];
        rewards[..len].iter_mut().zip(from).for_each(|(reward, value)| *reward = *value as f32);
        Some(SegmentMeta {
            flags: HINDSIGHT | if end.is_some() { TERMINATED } else { 0 },
            policy_version: draw.policy_version,
            episode_step: draw.first as u32,
            steps: len,
        })
    }

    /// Starts the next episode of environment `env`.
    pub(crate) fn begin_episode(&mut self, env: usize) {
        self.episodes[env].steps = 0;
        self.episodes[env].segments.clear();
    }
}
