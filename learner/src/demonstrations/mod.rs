//! Demonstrations: recorded steps, read from files before a run begins.
//!
//! They are inserted into the replay as segments that are never replaced, and the actor imitates
//! them before the first update (`algorithms::cloning`). docs/demonstrations.md describes the file.

mod file;

use std::path::{Path, PathBuf};

use dmprl_shared::policy::{CommandState, Policy};
use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TERMINATED, TRUNCATED};
use dmprl_shared::spec::EnvSpec;
use thiserror::Error;

use crate::replay::Replay;

/// Why demonstrations were rejected.
#[derive(Debug, Error)]
pub enum DemonstrationError {
    /// The file is not a NumPy archive.
    #[error(
        "{}: {reason}; expected a file written with numpy.savez (not savez_compressed); \
         docs/demonstrations.md describes it", file.display()
    )]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// Why it could not be read.
        reason: String,
    },
    /// An array or one of its rows is invalid.
    #[error(
        "{}: {key}: expected {expected}, got {got}; docs/demonstrations.md describes the file",
        file.display()
    )]
    Array {
        /// The file.
        file: PathBuf,
        /// Name of the array, with row and entry if one is invalid.
        key: String,
        /// The expected value.
        expected: String,
        /// The value in the file.
        got: String,
    },
    /// The demonstrations would leave too little room in the replay.
    #[error(
        "demonstrations of {segments} segments would fill more than half of the replay's {slots}; \
         use fewer, or raise replay.capacity_steps"
    )]
    TooMany {
        /// Segments of the demonstrations.
        segments: usize,
        /// Capacity of the replay in segments.
        slots: usize,
    },
}

/// N recorded steps in order, episode after episode.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Demonstration {
    /// Observations before each step, (N, O), with the state of the commands if the policy has it.
    pub observations: Vec<f32>,
    /// Actions u in [-1, 1], (N, A).
    pub actions: Vec<f32>,
    /// Rewards, (N,).
    pub rewards: Vec<f32>,
    /// Observations after each step, (N, O).
    pub next_observations: Vec<f32>,
    /// Whether the task terminated the episode at the step, (N,).
    pub terminated: Vec<bool>,
    /// Whether a time limit or the end of the recording ended the episode at the step, (N,).
    pub truncated: Vec<bool>,
}

/// Figures that summarise demonstrations.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DemonstrationSummary {
    /// Number of episodes. The last one of a file may be cut short.
    pub episodes: usize,
    /// Number of steps.
    pub steps: usize,
    /// Sum of all rewards.
    pub rewards: f64,
}

impl Demonstration {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// If the file is unreadable or an array is invalid.
    pub fn read(path: &Path, spec: &EnvSpec, policy: &Policy) -> Result<Self, DemonstrationError> {
        let mut demonstration = file::read(path, spec, policy.scaling())?;
        if let Some(commands) = policy.command_state() {
            demonstration.append_states(commands, policy.layout());
        }
        Ok(demonstration)
    }

    /// Returns the number of steps, N.
    #[must_use]
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// Returns whether there are no steps.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// Returns figures that summarise the steps.
    #[must_use]
    pub fn summary(&self) -> DemonstrationSummary {
        DemonstrationSummary {
            episodes: self.ends().count(),
            steps: self.len(),
            rewards: self.rewards.iter().map(|reward| f64::from(*reward)).sum(),
        }
    }

    /// Appends the state of the commands to every observation.
    fn append_states(&mut self, commands: &CommandState, layout: SegmentLayout) {
        let (o, a) = (layout.observation_len, layout.action_len);
        let env_len = o - 2 * a;
        let mut state = vec![0.0; 2 * a];
        let (mut observations, mut next_observations) = (Vec::new(), Vec::new());
        for row in 0..self.len() {
            let own = row * env_len..(row + 1) * env_len;
            observations.extend_from_slice(&self.observations[own.clone()]);
            observations.extend_from_slice(&state);
            commands.follow(&self.actions[row * a..(row + 1) * a], &mut state);
            next_observations.extend_from_slice(&self.next_observations[own]);
            next_observations.extend_from_slice(&state);
            if self.is_end(row) {
                state.fill(0.0);
            }
        }
        self.observations = observations;
        self.next_observations = next_observations;
    }

    fn is_end(&self, row: usize) -> bool {
        self.terminated[row] || self.truncated[row] || row + 1 == self.len()
    }

    fn ends(&self) -> impl Iterator<Item = usize> {
        (0..self.len()).filter(|&row| self.is_end(row))
    }

    /// Cuts each episode into segments from its first step on, and inserts them into a replay that
    /// has only demonstrations.
    ///
    /// # Errors
    /// [`DemonstrationError::TooMany`] if they would fill more than half of the replay.
    pub fn insert_into(&self, replay: &mut Replay) -> Result<(), DemonstrationError> {
        let layout = replay.layout();
        let (k_max, o, a) = (layout.segment_steps, layout.observation_len, layout.action_len);
        let mut lengths = Vec::new();
        let mut first = 0;
        for end in self.ends() {
            lengths.push((first, end + 1 - first));
            first = end + 1;
        }
        let segments: usize = lengths.iter().map(|(_, len)| len.div_ceil(k_max)).sum();
        let (held, slots) = (replay.len(), replay.capacity());
        if 2 * (held + segments) > slots {
            return Err(DemonstrationError::TooMany { segments: held + segments, slots });
        }
        let mut block = vec![0.0; layout.block_len()];
        for (episode, len) in lengths {
            for start in (0..len).step_by(k_max) {
                let (row, steps) = (episode + start, (len - start).min(k_max));
                block.fill(0.0);
                let (observations, actions, rewards) = layout.split_mut(&mut block);
                let last = row + steps - 1;
                observations[..steps * o]
                    .copy_from_slice(&self.observations[row * o..(last + 1) * o]);
                observations[steps * o..(steps + 1) * o]
                    .copy_from_slice(&self.next_observations[last * o..(last + 1) * o]);
                actions[..steps * a].copy_from_slice(&self.actions[row * a..(last + 1) * a]);
                rewards[..steps].copy_from_slice(&self.rewards[row..=last]);
                let flags = match (self.is_end(last), self.terminated[last]) {
                    (false, _) => 0,
                    (true, true) => TERMINATED,
                    (true, false) => TRUNCATED,
                };
                let header = SegmentHeader {
                    flags,
                    episode_step: start as u32,
                    steps_len: steps as u32,
                    ..SegmentHeader::default()
                };
                replay.insert_demonstration(&header, &block);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests;
