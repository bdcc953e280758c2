//! Stage 4 of 8, its record: the segment, K steps that a worker sends to the learner as a fixed
//! header and one block of f32.
//!
//! Block of a segment with K steps, observation length O and action length A:
//! ```text
//!   observations (K+1, O)   row k: before step k; row steps_len: after the last executed step
//!   actions      (K, A)     u, in [-1, 1] unless drawn from a Gaussian; zero after steps_len
//!   rewards      (K,)       zero after steps_len
//! ```
//! An observation here is the policy's input: the environment's observation, followed by the state
//! (y, yd) of DMP or commands from which a segment starts, if the policy has one.

use bytemuck::{Pod, Zeroable};
pub use dmprl_runtime::segment_layout::{ActionBounds, SegmentLayout};
use thiserror::Error;

/// Version of this layout; peers with another version are rejected.
pub const LAYOUT_VERSION: u32 = 1;

/// The last step reached a terminal state of the task.
pub const TERMINATED: u32 = 1;
/// The last step reached the time limit.
pub const TRUNCATED: u32 = 1 << 1;
/// The environment reported success at the last step.
pub const SUCCESS: u32 = 1 << 2;
/// The environment reports success. Without this flag [`SUCCESS`] has no meaning.
pub const SUCCESS_REPORTED: u32 = 1 << 3;
/// The segment is a hindsight copy: steps of other segments with another goal.
///
/// A copy counts as experience, but not as environment steps or as part of an episode. It has all K
/// steps or is [`TERMINATED`].
pub const HINDSIGHT: u32 = 1 << 4;

const KNOWN_FLAGS: u32 = TERMINATED | TRUNCATED | SUCCESS | SUCCESS_REPORTED | HINDSIGHT;

/// Metadata of a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct SegmentHeader {
    /// [`LAYOUT_VERSION`] of the sender.
    pub layout_version: u32,
    /// [`TERMINATED`] | [`TRUNCATED`] | [`SUCCESS`] | [`SUCCESS_REPORTED`] | [`HINDSIGHT`].
    pub flags: u32,
    /// Run that the segment belongs to.
    pub run_id: u64,
    /// Hash of the acting policy's architecture.
    pub architecture_hash: u64,
    /// Version of the acting policy; 0 during the warm-up.
    pub policy_version: u64,
    /// Sequence number, from 1 without gaps, per worker and incarnation.
    pub sequence: u64,
    /// Worker that produced the segment.
    pub worker_id: u32,
    /// How many times the worker has been started; it distinguishes restarts of the same worker.
    pub incarnation: u32,
    /// Index of the worker's environment.
    pub env_index: u32,
    /// Number of the episode, per environment and incarnation.
    pub episode: u32,
    /// Steps of the episode before this segment.
    pub episode_step: u32,
    /// Executed steps, 1 to K.
    pub steps_len: u32,
    /// Segment length K \[steps\].
    pub segment_steps: u32,
    /// Observation length O.
    pub observation_len: u32,
    /// Action length A.
    pub action_len: u32,
    /// CRC-32 of the block.
    pub checksum: u32,
}

// Processes exchange the header as bytes, so its layout must not change by accident.
const _: () = assert!(size_of::<SegmentHeader>() == 80 && align_of::<SegmentHeader>() == 8);

/// An owned segment.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Segment {
    /// The metadata.
    pub header: SegmentHeader,
    /// Observations, actions and rewards; the module documentation describes the layout.
    pub block: Vec<f32>,
}

impl Segment {
    /// Creates a segment whose header and block are all zero.
    #[must_use]
    pub fn zeroed(layout: SegmentLayout) -> Self {
        Self { header: SegmentHeader::default(), block: vec![0.0; layout.block_len()] }
    }
}

/// Properties that a segment must have to be accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Expected {
    /// Run that the segment must belong to.
    pub run_id: u64,
    /// Hash of the policy's architecture.
    pub architecture_hash: u64,
    /// Sizes of the block.
    pub layout: SegmentLayout,
    /// Number of workers; valid ids are smaller.
    pub worker_count: u32,
    /// Environments per worker; valid indices are smaller.
    pub env_count: u32,
    /// Range of the policy's actions.
    pub action_bounds: ActionBounds,
}

/// Why a segment was rejected. The metrics count each variant separately.
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
    /// Different sizes K, O or A, or a wrong block length.
    #[error("sizes")]
    Sizes,
    /// Worker, environment, sequence or step count out of range, or unknown flags.
    #[error("header field out of range")]
    Field,
    /// The block's checksum does not match.
    #[error("checksum")]
    Checksum,
    /// A number that is NaN or infinite, or an action outside its bounds.
    #[error("value not finite or action out of bounds")]
    Value,
    /// A sequence number that this worker has already used. [`check`] does not detect it; the
    /// learner does, which tracks sequence numbers.
    #[error("duplicate")]
    Duplicate,
}

/// Checks a segment: header fields, checksum and values.
///
/// # Errors
/// The first reason for a rejection. The header is checked before the block.
pub fn check(header: &SegmentHeader, block: &[f32], expected: &Expected) -> Result<(), Rejection> {
    let reject_if = |wrong: bool, why: Rejection| if wrong { Err(why) } else { Ok(()) };
    let layout = expected.layout;
    let sizes = [header.segment_steps, header.observation_len, header.action_len];
    let wanted = [layout.segment_steps, layout.observation_len, layout.action_len];
    reject_if(header.layout_version != LAYOUT_VERSION, Rejection::LayoutVersion)?;
    reject_if(header.run_id != expected.run_id, Rejection::Run)?;
    reject_if(header.architecture_hash != expected.architecture_hash, Rejection::Architecture)?;
    reject_if(sizes.map(|size| size as usize) != wanted, Rejection::Sizes)?;
    reject_if(block.len() != layout.block_len(), Rejection::Sizes)?;
    let in_range = header.worker_id < expected.worker_count
        && header.env_index < expected.env_count
        && header.sequence > 0
        && (1..=header.segment_steps).contains(&header.steps_len)
        && header.episode_step.checked_add(header.steps_len).is_some()
        && header.flags & !KNOWN_FLAGS == 0
        && (header.flags & HINDSIGHT == 0 || header.flags & !(HINDSIGHT | TERMINATED) == 0)
        && (header.steps_len == header.segment_steps
            || header.flags & (TERMINATED | TRUNCATED) != 0);
    reject_if(!in_range, Rejection::Field)?;
    reject_if(block_checksum(block) != header.checksum, Rejection::Checksum)?;
    let (_, actions, _) = layout.split(block);
    let valid = all(block, |value| value.is_finite())
        && (expected.action_bounds == ActionBounds::None
            || all(actions, |action| action.abs() <= 1.0));
    reject_if(!valid, Rejection::Value)
}

/// Returns whether all values satisfy the predicate. Without an early return the compiler
/// vectorises the loop, which makes it ten times as fast.
fn all(values: &[f32], predicate: impl Fn(f32) -> bool) -> bool {
    values.iter().fold(true, |valid, &value| valid & predicate(value))
}

/// Returns the CRC-32 of a block.
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

    fn valid_segment() -> Segment {
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

    fn check_changed(change: impl FnOnce(&mut Segment)) -> Result<(), Rejection> {
        let mut segment = valid_segment();
        change(&mut segment);
        check(&segment.header, &segment.block, &EXPECTED)
    }

    #[test]
    fn valid_segment_is_accepted() {
        assert_eq!(check_changed(|_| {}), Ok(()));
    }

    #[test]
    fn every_misfit_is_refused_with_its_reason() {
        assert_eq!(check_changed(|s| s.header.layout_version = 2), Err(Rejection::LayoutVersion));
        assert_eq!(check_changed(|s| s.header.run_id = 8), Err(Rejection::Run));
        assert_eq!(check_changed(|s| s.header.architecture_hash = 8), Err(Rejection::Architecture));
        assert_eq!(check_changed(|s| s.header.observation_len = 4), Err(Rejection::Sizes));
        assert_eq!(check_changed(|s| s.block.truncate(3)), Err(Rejection::Sizes));
        assert_eq!(check_changed(|s| s.header.steps_len = 0), Err(Rejection::Field));
        assert_eq!(check_changed(|s| s.header.steps_len = 6), Err(Rejection::Field));
        assert_eq!(check_changed(|s| s.header.steps_len = 4), Err(Rejection::Field));
        assert_eq!(check_changed(|s| s.header.episode_step = u32::MAX - 4), Err(Rejection::Field));
        assert_eq!(check_changed(|s| s.header.worker_id = 2), Err(Rejection::Field));
        assert_eq!(check_changed(|s| s.header.env_index = 4), Err(Rejection::Field));
        assert_eq!(check_changed(|s| s.header.sequence = 0), Err(Rejection::Field));
        assert_eq!(check_changed(|s| s.header.flags = 32), Err(Rejection::Field));
        assert_eq!(check_changed(|s| s.block[0] = 1.0), Err(Rejection::Checksum));
        for value in [f32::NAN, f32::INFINITY, 1.5] {
            let change = |s: &mut Segment| {
                s.block[18] = value;
                s.header.checksum = block_checksum(&s.block);
            };
            assert_eq!(check_changed(change), Err(Rejection::Value));
        }
    }

    #[test]
    fn unbounded_policy_may_exceed_the_bounds_but_not_send_nan() {
        let expected = Expected { action_bounds: ActionBounds::None, ..EXPECTED };
        let check_action = |value: f32| {
            let mut segment = valid_segment();
            segment.block[18] = value;
            segment.header.checksum = block_checksum(&segment.block);
            check(&segment.header, &segment.block, &expected)
        };
        assert_eq!(check_action(1.5), Ok(()));
        assert_eq!(check_action(f32::NAN), Err(Rejection::Value));
        assert_eq!(check_action(f32::INFINITY), Err(Rejection::Value));
    }

    #[test]
    fn hindsight_copy_is_complete_or_terminated_and_not_part_of_an_episode() {
        let check_copy = |flags: u32, steps_len: u32| {
            check_changed(|s| (s.header.flags, s.header.steps_len) = (HINDSIGHT | flags, steps_len))
        };
        assert_eq!((check_copy(0, 5), check_copy(TERMINATED, 2)), (Ok(()), Ok(())));
        for (flags, len) in [(0, 4), (TRUNCATED, 5), (TRUNCATED, 4), (SUCCESS_REPORTED, 5)] {
            assert_eq!(check_copy(flags, len), Err(Rejection::Field), "{flags} {len}");
        }
    }

    #[test]
    fn segment_shortened_by_the_end_of_an_episode_is_accepted() {
        let change = |s: &mut Segment| {
            s.header.steps_len = 2;
            s.header.flags = TERMINATED | SUCCESS;
        };
        assert_eq!(check_changed(change), Ok(()));
    }
}
