//! Demonstrations: steps that somebody recorded, read from files before a run begins.
//!
//! They enter the replay as segments that are never replaced, and the actor imitates them before
//! anything else is learned (`algorithms::cloning`). docs/demonstrations.md describes the file.

mod file;

use std::path::{Path, PathBuf};

use dmprl_shared::policy::Policy;
use dmprl_shared::segment::{SegmentHeader, TERMINATED, TRUNCATED};
use dmprl_shared::spec::EnvSpec;
use thiserror::Error;

use crate::replay::Replay;

/// Why demonstrations were refused.
#[derive(Debug, Error)]
pub enum DemonstrationError {
    /// Not a file of arrays.
    #[error(
        "{}: {reason}; expected a file written with numpy.savez (not savez_compressed), as \
         docs/demonstrations.md describes it", file.display()
    )]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// What reading it ended with.
        reason: String,
    },
    /// An array, or a row of one, that does not fit.
    #[error(
        "{}: {key}: expected {expected}, got {got}; docs/demonstrations.md describes the file",
        file.display()
    )]
    Array {
        /// The file.
        file: PathBuf,
        /// Name of the array, with row and entry where one is to blame.
        key: String,
        /// What must hold.
        expected: String,
        /// What is there.
        got: String,
    },
    /// More than a replay that must also hold what is learned from.
    #[error(
        "demonstrations of {segments} segments would fill more than half of the replay's {slots}; \
         give fewer, or raise replay.capacity_steps"
    )]
    TooMany {
        /// Segments they make.
        segments: usize,
        /// Segments the replay holds.
        slots: usize,
    },
}

/// N steps in the order in which they happened, episode after episode.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Steps {
    /// Before each step, (N, O).
    pub observations: Vec<f32>,
    /// u in [-1, 1], (N, A).
    pub actions: Vec<f32>,
    /// (N,).
    pub rewards: Vec<f32>,
    /// After each step, (N, O).
    pub next_observations: Vec<f32>,
    /// Whether the step ended its episode by the task's own rule, (N,).
    pub terminated: Vec<bool>,
    /// Whether a time limit, or the end of the recording, did, (N,).
    pub truncated: Vec<bool>,
}

/// What was read, in a few figures.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Summary {
    /// Episodes, the last of a file possibly cut short.
    pub episodes: usize,
    /// Steps.
    pub steps: usize,
    /// Sum of all rewards.
    pub rewards: f64,
}

impl Steps {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// What does not fit, with file, array, row, expected and got.
    pub fn read(path: &Path, spec: &EnvSpec, policy: &Policy) -> Result<Self, DemonstrationError> {
        file::read(path, spec, policy.scaling())
    }

    /// Number N.
    #[must_use]
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// In a few figures.
    #[must_use]
    pub fn summary(&self) -> Summary {
        Summary {
            episodes: self.ends().count(),
            steps: self.len(),
            rewards: self.rewards.iter().map(|reward| f64::from(*reward)).sum(),
        }
    }

    fn is_end(&self, row: usize) -> bool {
        self.terminated[row] || self.truncated[row] || row + 1 == self.len()
    }

    fn ends(&self) -> impl Iterator<Item = usize> {
        (0..self.len()).filter(|&row| self.is_end(row))
    }

    /// Inserts everything into a replay that holds nothing but demonstrations, cut into segments
    /// from each episode's first step on.
    ///
    /// # Errors
    /// `TooMany`.
    pub fn enter(&self, replay: &mut Replay) -> Result<(), DemonstrationError> {
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
                replay.keep(&header, &block);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests;
