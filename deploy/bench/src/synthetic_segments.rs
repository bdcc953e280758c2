//! Generates synthetic segments of a given size in bytes.

use dmprl_shared::segment::{
    ActionBounds, Expected, LAYOUT_VERSION, Segment, SegmentHeader, SegmentLayout, TRUNCATED,
    block_checksum,
};
use dmprl_shared::transport::shared_memory::Plan;

/// Segment sizes of the benchmark, header plus block.
pub(super) const SIZES: [Size; 2] =
    [Size { bytes: 1_024, layout: layout(36, 3) }, Size { bytes: 10_240, layout: layout(405, 21) }];
/// Segment size of the benchmark between hosts.
pub(super) const SIZE_BETWEEN_HOSTS: Size = Size { bytes: 2_048, layout: layout(77, 5) };
/// Capacity of a worker's queue and of its outbox. Both fill up when the receiver pauses.
pub(super) const QUEUE_SEGMENTS: usize = 512;

/// Run id in the synthetic segments.
pub(super) const RUN_ID: u64 = 1;
/// Segments per episode, so that the replay has successive segments to link.
const EPISODE_SEGMENTS: u64 = 10;
const ARCHITECTURE_HASH: u64 = 1;
/// Phase step between two values. The sine never repeats, because 0.37 / 2 pi is irrational.
const STRIDE: f32 = 0.37;
/// Integers up to this one are exact in an f32.
const STAMP_MAX: u64 = 1 << 24;

/// A segment's size in bytes and the layout that results in it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Size {
    pub(super) bytes: usize,
    pub(super) layout: SegmentLayout,
}

const fn layout(observation_len: usize, action_len: usize) -> SegmentLayout {
    SegmentLayout { segment_steps: 5, observation_len, action_len }
}

impl Size {
    /// Returns the benchmark's size with this number of bytes, if there is one.
    pub(super) fn of_bytes(bytes: usize) -> Option<Self> {
        SIZES.into_iter().find(|size| size.bytes == bytes)
    }

    /// Returns the plan of the shared memory between the workers and the receiver.
    pub(super) fn plan(self, workers: usize) -> Plan {
        Plan {
            run_id: RUN_ID,
            architecture_hash: ARCHITECTURE_HASH,
            layout: self.layout,
            worker_count: workers,
            queue_segments: QUEUE_SEGMENTS,
            parameters_len: 1,
        }
    }

    /// Returns the values that a valid segment must have.
    pub(super) fn expected(self, workers: u32) -> Expected {
        Expected {
            run_id: RUN_ID,
            architecture_hash: ARCHITECTURE_HASH,
            layout: self.layout,
            worker_count: workers,
            env_count: 1,
            action_bounds: ActionBounds::Unit,
        }
    }
}

/// Generates the segments of one worker.
#[derive(Debug)]
pub(super) struct SyntheticSegments(Segment);

impl SyntheticSegments {
    /// Creates the generator for a worker.
    pub(super) fn new(layout: SegmentLayout, worker_id: u32) -> Self {
        Self::with_hash(layout, worker_id, ARCHITECTURE_HASH)
    }

    /// Creates the generator for a worker of a learner with this architecture hash.
    pub(super) fn with_hash(layout: SegmentLayout, worker_id: u32, architecture_hash: u64) -> Self {
        let mut segment = Segment::zeroed(layout);
        for (index, value) in segment.block.iter_mut().enumerate() {
            *value = (index as f32 * STRIDE).sin();
        }
        segment.header = SegmentHeader {
            layout_version: LAYOUT_VERSION,
            run_id: RUN_ID,
            architecture_hash,
            worker_id,
            steps_len: layout.segment_steps as u32,
            segment_steps: layout.segment_steps as u32,
            observation_len: layout.observation_len as u32,
            action_len: layout.action_len as u32,
            ..SegmentHeader::default()
        };
        Self(segment)
    }

    /// Generates the next segment, with a new sequence number, other values and a valid checksum.
    pub(super) fn next(&mut self) -> &Segment {
        let Segment { header, block } = &mut self.0;
        let (episode, index) =
            (header.sequence / EPISODE_SEGMENTS, header.sequence % EPISODE_SEGMENTS);
        header.episode = episode as u32;
        header.episode_step = index as u32 * header.segment_steps;
        header.flags = if index + 1 == EPISODE_SEGMENTS { TRUNCATED } else { 0 };
        header.sequence += 1;
        block[0] = (header.sequence % STAMP_MAX) as f32;
        header.checksum = block_checksum(block);
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::segment::check;

    use super::*;

    #[test]
    fn synthetic_segments_are_valid_and_have_their_size() {
        for size in SIZES.into_iter().chain([SIZE_BETWEEN_HOSTS]) {
            let mut synthetic_segments = SyntheticSegments::new(size.layout, 1);
            let checksums = [1, 2].map(|sequence| {
                let Segment { header, block } = synthetic_segments.next();
                assert_eq!(size_of_val(header) + size_of_val(&block[..]), size.bytes);
                assert_eq!(header.sequence, sequence);
                assert_eq!(check(header, block, &size.expected(2)), Ok(()));
                header.checksum
            });
            assert_ne!(checksums[0], checksums[1]);
        }
    }

    #[test]
    fn synthetic_segments_form_episodes() {
        let layout = SIZES[0].layout;
        let mut synthetic_segments = SyntheticSegments::with_hash(layout, 0, 7);
        let mut next = || synthetic_segments.next().header;
        let (first, second) = (next(), next());
        assert_eq!((first.episode, first.episode_step, first.architecture_hash), (0, 0, 7));
        assert_eq!((second.episode, second.episode_step), (0, layout.segment_steps as u32));
        let tenth = (2..10).map(|_| next()).last().unwrap();
        assert_eq!((tenth.episode, tenth.flags), (0, TRUNCATED));
        assert_eq!((next().episode, next().flags), (1, 0));
    }
}
