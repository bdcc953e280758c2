//! The K-step record that travels from worker to learner: a fixed header and one block of f32.
//!
//! Block of a segment with K steps, observation length O and action length A:
//! ```text
//!   observations (K+1, O)   row k: before step k; row steps_len: after the last step really run
//!   actions      (K, A)     u, in [-1, 1] unless drawn from a Gaussian; zero after steps_len
//!   rewards      (K,)       zero after steps_len
//! ```
//! An observation here is what the policy sees: the environment's, followed by the DMP state
//! (y, yd) when the policy carries it from segment to segment.

use bytemuck::{Pod, Zeroable};
use thiserror::Error;

/// Version of this layout; peers of another version are refused.
pub const LAYOUT_VERSION: u32 = 1;

/// The last step ended the episode by the task's own rule.
pub const TERMINATED: u32 = 1;
/// The last step was the last that the time limit allows.
pub const TRUNCATED: u32 = 1 << 1;
/// The environment reported success at the last step.
pub const SUCCESS: u32 = 1 << 2;
/// The environment says whether it succeeded; without it [`SUCCESS`] means nothing.
pub const SUCCESS_REPORTED: u32 = 1 << 3;
/// A copy of steps that other segments hold, with another goal (hindsight): experience, but no
/// steps of an environment and no part of its episode. Whole, or [`TERMINATED`].
pub const HINDSIGHT: u32 = 1 << 4;

const KNOWN_FLAGS: u32 = TERMINATED | TRUNCATED | SUCCESS | SUCCESS_REPORTED | HINDSIGHT;

/// Everything about a segment except its numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct SegmentHeader {
    /// [`LAYOUT_VERSION`] of the sender.
    pub layout_version: u32,
    /// [`TERMINATED`] | [`TRUNCATED`] | [`SUCCESS`] | [`SUCCESS_REPORTED`] | [`HINDSIGHT`].
    pub flags: u32,
    /// Which run the segment belongs to.
    pub run_id: u64,
    /// Hash of the architecture that acted.
    pub architecture_hash: u64,
    /// Version of the policy that acted; 0 during the warm-up.
    pub policy_version: u64,
    /// Counts this worker's segments, from 1, without gaps, over one incarnation.
    pub sequence: u64,
    /// Which worker.
    pub worker_id: u32,
    /// Counts the worker's starts.
    pub incarnation: u32,
    /// Which of the worker's environments.
    pub env_index: u32,
    /// Counts this environment's episodes over one incarnation.
    pub episode: u32,
    /// Environment steps of the episode before this segment.
    pub episode_step: u32,
    /// Steps really run, 1 to K.
    pub steps_len: u32,
    /// K.
    pub segment_steps: u32,
    /// O.
    pub observation_len: u32,
    /// A.
    pub action_len: u32,
    /// CRC-32 of the block.
    pub checksum: u32,
}

// The header is shared memory between processes: its layout may not drift unnoticed.
const _: () = assert!(size_of::<SegmentHeader>() == 80 && align_of::<SegmentHeader>() == 8);

/// The sizes that decide a block's layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SegmentLayout {
    /// K.
    pub segment_steps: usize,
    /// O, DMP state included when carried.
    pub observation_len: usize,
    /// A.
    pub action_len: usize,
}

impl SegmentLayout {
    /// Length of the block.
    #[must_use]
    pub fn block_len(&self) -> usize {
        self.actions_len() + self.observations_len() + self.segment_steps
    }

    fn observations_len(&self) -> usize {
        (self.segment_steps + 1) * self.observation_len
    }

    /// Actions of a segment, K A.
    #[must_use]
    pub fn actions_len(&self) -> usize {
        self.segment_steps * self.action_len
    }

    /// Splits a block into observations, actions and rewards.
    ///
    /// # Panics
    /// If the block's length is not [`SegmentLayout::block_len`].
    #[must_use]
    pub fn split<'a>(&self, block: &'a [f32]) -> (&'a [f32], &'a [f32], &'a [f32]) {
        assert_eq!(block.len(), self.block_len(), "segment block length");
        let (observations, rest) = block.split_at(self.observations_len());
        let (actions, rewards) = rest.split_at(self.actions_len());
        (observations, actions, rewards)
    }

    /// As [`SegmentLayout::split`], to write.
    ///
    /// # Panics
    /// If the block's length is not [`SegmentLayout::block_len`].
    #[must_use]
    pub fn split_mut<'a>(
        &self,
        block: &'a mut [f32],
    ) -> (&'a mut [f32], &'a mut [f32], &'a mut [f32]) {
        assert_eq!(block.len(), self.block_len(), "segment block length");
        let (observations, rest) = block.split_at_mut(self.observations_len());
        let (actions, rewards) = rest.split_at_mut(self.actions_len());
        (observations, actions, rewards)
    }
}

/// A segment in memory of its own.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Segment {
    /// Everything but the numbers.
    pub header: SegmentHeader,
    /// The numbers; see the module's doc for the layout.
    pub block: Vec<f32>,
}

impl Segment {
    /// A zeroed segment of the given layout.
    #[must_use]
    pub fn zeroed(layout: SegmentLayout) -> Self {
        Self { header: SegmentHeader::default(), block: vec![0.0; layout.block_len()] }
    }
}

/// What an action in a segment may be, besides finite.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ActionBounds {
    /// In [-1, 1].
    Unit,
    /// Any number: as drawn from an unbounded distribution, before the environment's bounds.
    None,
}

/// What a segment must match to be taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Expected {
    /// The run.
    pub run_id: u64,
    /// The policy's architecture.
    pub architecture_hash: u64,
    /// The block's sizes.
    pub layout: SegmentLayout,
    /// Workers of the run: valid ids are below.
    pub worker_count: u32,
    /// Environments of a worker: valid indices are below.
    pub env_count: u32,
    /// What the policy's actions may be.
    pub action_bounds: ActionBounds,
}

/// Why a segment was refused. Each variant has its own counter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Error)]
pub enum Rejection {
    /// Another layout version.
    #[error("layout version")]
    LayoutVersion,
    /// Another run.
    #[error("run id")]
    Run,
    /// Another architecture.
    #[error("architecture hash")]
    Architecture,
    /// Sizes K, O, A or the block's length differ.
    #[error("sizes")]
    Sizes,
    /// Worker, environment, sequence or step count out of range, or unknown flags.
    #[error("header field out of range")]
    Field,
    /// The block's checksum differs.
    #[error("checksum")]
    Checksum,
    /// A number that is NaN or infinite, or an action outside its bounds.
    #[error("value not finite or action out of bounds")]
    Value,
    /// A sequence number that this worker has already used. Only the learner, who remembers, finds
    /// it.
    #[error("duplicate")]
    Duplicate,
}

/// Refuses a segment that does not fit.
///
/// # Errors
/// The first reason found; header before block.
pub fn check(header: &SegmentHeader, block: &[f32], expected: &Expected) -> Result<(), Rejection> {
    let refuse = |wrong: bool, why: Rejection| if wrong { Err(why) } else { Ok(()) };
    let layout = expected.layout;
    let sizes = [header.segment_steps, header.observation_len, header.action_len];
    let wanted = [layout.segment_steps, layout.observation_len, layout.action_len];
    refuse(header.layout_version != LAYOUT_VERSION, Rejection::LayoutVersion)?;
    refuse(header.run_id != expected.run_id, Rejection::Run)?;
    refuse(header.architecture_hash != expected.architecture_hash, Rejection::Architecture)?;
    refuse(sizes.map(|size| size as usize) != wanted, Rejection::Sizes)?;
    refuse(block.len() != layout.block_len(), Rejection::Sizes)?;
    let in_range = header.worker_id < expected.worker_count
        && header.env_index < expected.env_count
        && header.sequence > 0
        && (1..=header.segment_steps).contains(&header.steps_len)
        && header.episode_step.checked_add(header.steps_len).is_some()
        && header.flags & !KNOWN_FLAGS == 0
        && (header.flags & HINDSIGHT == 0 || header.flags & !(HINDSIGHT | TERMINATED) == 0)
        && (header.steps_len == header.segment_steps
            || header.flags & (TERMINATED | TRUNCATED) != 0);
    refuse(!in_range, Rejection::Field)?;
    refuse(block_checksum(block) != header.checksum, Rejection::Checksum)?;
    let (_, actions, _) = layout.split(block);
    let sound = all(block, |value| value.is_finite())
        && (expected.action_bounds == ActionBounds::None
            || all(actions, |action| action.abs() <= 1.0));
    refuse(!sound, Rejection::Value)
}

/// Whether all values pass. To the end in any case: without a way out the loop becomes vector
/// instructions, which take a tenth of the time.
fn all(values: &[f32], passes: impl Fn(f32) -> bool) -> bool {
    values.iter().fold(true, |sound, &value| sound & passes(value))
}

/// CRC-32 of a block.
#[must_use]
pub fn block_checksum(block: &[f32]) -> u32 {
    crc32fast::hash(bytemuck::cast_slice(block))
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 5, observation_len: 3, action_len: 2 };
    const EXPECTED: Expected = Expected {
        run_id: 7,
        architecture_hash: 9,
        layout: LAYOUT,
        worker_count: 2,
        env_count: 4,
        action_bounds: ActionBounds::Unit,
    };

    fn sound() -> Segment {
        let mut segment = Segment::zeroed(LAYOUT);
        segment.header = SegmentHeader {
            layout_version: LAYOUT_VERSION,
            run_id: 7,
            architecture_hash: 9,
            sequence: 1,
            steps_len: 5,
            segment_steps: 5,
            observation_len: 3,
            action_len: 2,
            checksum: block_checksum(&segment.block),
            ..SegmentHeader::default()
        };
        segment
    }

    fn verdict(change: impl FnOnce(&mut Segment)) -> Result<(), Rejection> {
        let mut segment = sound();
        change(&mut segment);
        check(&segment.header, &segment.block, &EXPECTED)
    }

    #[test]
    fn a_sound_segment_is_taken() {
        assert_eq!(verdict(|_| {}), Ok(()));
    }

    #[test]
    fn every_misfit_is_refused_with_its_reason() {
        assert_eq!(verdict(|s| s.header.layout_version = 2), Err(Rejection::LayoutVersion));
        assert_eq!(verdict(|s| s.header.run_id = 8), Err(Rejection::Run));
        assert_eq!(verdict(|s| s.header.architecture_hash = 8), Err(Rejection::Architecture));
        assert_eq!(verdict(|s| s.header.observation_len = 4), Err(Rejection::Sizes));
        assert_eq!(verdict(|s| s.block.truncate(3)), Err(Rejection::Sizes));
        assert_eq!(verdict(|s| s.header.steps_len = 0), Err(Rejection::Field));
        assert_eq!(verdict(|s| s.header.steps_len = 6), Err(Rejection::Field));
        assert_eq!(verdict(|s| s.header.steps_len = 4), Err(Rejection::Field));
        assert_eq!(verdict(|s| s.header.episode_step = u32::MAX - 4), Err(Rejection::Field));
        assert_eq!(verdict(|s| s.header.worker_id = 2), Err(Rejection::Field));
        assert_eq!(verdict(|s| s.header.env_index = 4), Err(Rejection::Field));
        assert_eq!(verdict(|s| s.header.sequence = 0), Err(Rejection::Field));
        assert_eq!(verdict(|s| s.header.flags = 32), Err(Rejection::Field));
        assert_eq!(verdict(|s| s.block[0] = 1.0), Err(Rejection::Checksum));
        for value in [f32::NAN, f32::INFINITY, 1.5] {
            let change = |s: &mut Segment| {
                s.block[18] = value;
                s.header.checksum = block_checksum(&s.block);
            };
            assert_eq!(verdict(change), Err(Rejection::Value));
        }
    }

    #[test]
    fn an_action_beyond_the_bounds_is_taken_from_an_unbounded_policy_and_a_nan_is_not() {
        let expected = Expected { action_bounds: ActionBounds::None, ..EXPECTED };
        let verdict_on = |value: f32| {
            let mut segment = sound();
            segment.block[18] = value;
            segment.header.checksum = block_checksum(&segment.block);
            check(&segment.header, &segment.block, &expected)
        };
        assert_eq!(verdict_on(1.5), Ok(()));
        assert_eq!(verdict_on(f32::NAN), Err(Rejection::Value));
        assert_eq!(verdict_on(f32::INFINITY), Err(Rejection::Value));
    }

    #[test]
    fn a_copy_with_another_goal_is_whole_or_terminated_and_no_part_of_an_episode() {
        let verdict = |flags: u32, steps_len: u32| {
            verdict(|s| (s.header.flags, s.header.steps_len) = (HINDSIGHT | flags, steps_len))
        };
        assert_eq!((verdict(0, 5), verdict(TERMINATED, 2)), (Ok(()), Ok(())));
        for (flags, len) in [(0, 4), (TRUNCATED, 5), (TRUNCATED, 4), (SUCCESS_REPORTED, 5)] {
            assert_eq!(verdict(flags, len), Err(Rejection::Field), "{flags} {len}");
        }
    }

    #[test]
    fn a_segment_cut_short_by_the_episodes_end_is_taken() {
        let change = |s: &mut Segment| {
            s.header.steps_len = 2;
            s.header.flags = TERMINATED | SUCCESS;
        };
        assert_eq!(verdict(change), Ok(()));
    }
}
