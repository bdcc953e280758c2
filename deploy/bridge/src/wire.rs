//! Binary messages between relay and gateway: segments, acknowledgements and policies.
//!
//! Segments are sent as they are in shared memory, header and block, in ranges of consecutive
//! segments of one worker. A message's head reveals a different layout, a different byte order or
//! damage. The learner verifies the checksum of each block, as with any worker.
//!
//! Small and rare messages are JSON (`host_messages.rs`).

use bytemuck::{Pod, Zeroable};
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::segment::{Segment, SegmentHeader};
use dmprl_shared::transport::delivery::Watermark;
use thiserror::Error;

use crate::seal::SEAL_BYTES;

/// First four bytes of every message, which also reveal a different byte order.
const MAGIC: u32 = 0x4442_524d;
const HEADER_BYTES: usize = size_of::<SegmentHeader>();

/// Reason for which a message is rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum WireError {
    /// It does not begin with the protocol's magic number.
    #[error("expected a message of this protocol, got other bytes")]
    Foreign,
    /// Its length contradicts its head.
    #[error("expected {expected} bytes, got {got}")]
    Length {
        /// Length according to the head.
        expected: usize,
        /// Actual length.
        got: usize,
    },
    /// Its checksum is wrong.
    #[error("checksum {got:#010x}, expected {expected:#010x}")]
    Checksum {
        /// Checksum in the head.
        expected: u32,
        /// Checksum of the received bytes.
        got: u32,
    },
}

#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Head {
    magic: u32,
    /// Number of ranges or workers.
    count: u32,
    /// CRC-32 of the rest of the message, without the segments' blocks.
    checksum: u32,
    /// From a gateway a [`RunState`]; from a host 0.
    run_state: u32,
}

/// Consecutive segments of one worker; without segments it only reports the worker's progress.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct SegmentRange {
    /// The oldest segment that the host retains: all earlier ones are acknowledged.
    pub oldest: u64,
    /// Sequence number of the first segment of this range, or of the next one to send.
    pub start: u64,
    /// Index of the worker in the run.
    pub worker: u32,
    /// Incarnation of the worker.
    pub incarnation: u32,
    /// Counts how often all retained segments of the worker were sent again, from 1.
    pub retransmit_epoch: u32,
    /// Number of segments that follow.
    pub count: u32,
}

/// The gateway's acknowledgement to one worker: the state at the gateway and at the learner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct LinkAck {
    /// The learner has acknowledged all segments up to this sequence number.
    pub sequence: u64,
    /// The gateway has received all segments up to this sequence number.
    pub received: u64,
    /// Incarnation to which `sequence` belongs.
    pub incarnation: u32,
    /// Incarnation to which `received` belongs.
    pub received_incarnation: u32,
    /// Retransmit epoch in which a segment was missing, so that the host must begin the next one;
    /// 0 if none.
    pub rejected_epoch: u32,
    /// Padding of the last word.
    pub reserved: u32,
}

impl LinkAck {
    /// The learner's last acknowledgement.
    #[must_use]
    pub fn mark(&self) -> Watermark {
        Watermark { incarnation: self.incarnation, sequence: self.sequence }
    }
}

/// State of a run, as reported to the hosts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunState {
    /// The run continues.
    Running,
    /// The run is complete.
    Complete,
    /// The run was stopped and may be resumed.
    Stopped,
    /// The run continues without this host, which has left.
    Left,
}

impl RunState {
    fn of(number: u32) -> Self {
        match number {
            1 => Self::Complete,
            2 => Self::Stopped,
            3 => Self::Left,
            _ => Self::Running,
        }
    }

    fn number(self) -> u32 {
        match self {
            Self::Running => 0,
            Self::Complete => 1,
            Self::Stopped => 2,
            Self::Left => 3,
        }
    }
}

/// A message of segments under construction.
#[derive(Debug, Default)]
pub struct Batch {
    ranges: Vec<SegmentRange>,
    body: Vec<u8>,
    headers: crc32fast::Hasher,
}

impl Batch {
    /// Begins a range, to which the next segments belong.
    pub fn begin(&mut self, range: SegmentRange) {
        self.ranges.push(SegmentRange { count: 0, ..range });
    }

    /// Adds a segment to the current range.
    ///
    /// # Panics
    /// Without a current range.
    pub fn add(&mut self, header: &SegmentHeader, block: &[f32]) {
        let range = self.ranges.last_mut();
        range.expect("a segment belongs to a range").count += 1;
        self.headers.update(bytemuck::bytes_of(header));
        self.body.extend_from_slice(bytemuck::bytes_of(header));
        self.body.extend_from_slice(bytemuck::cast_slice(block));
    }

    /// Size of the segments so far in bytes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.body.len()
    }

    /// Returns true if no range has begun.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ranges.is_empty()
    }

    /// Finishes the message; the batch is empty afterwards.
    pub fn take(&mut self) -> Vec<u8> {
        let mut hasher = std::mem::take(&mut self.headers);
        hasher.update(bytemuck::cast_slice(&self.ranges));
        let count = u32::try_from(self.ranges.len()).unwrap_or(u32::MAX);
        let head = Head { magic: MAGIC, count, checksum: hasher.finalize(), run_state: 0 };
        let table = size_of_val(self.ranges.as_slice());
        let len = size_of::<Head>() + table + self.body.len();
        let mut message = Vec::with_capacity(len + SEAL_BYTES);
        message.extend_from_slice(bytemuck::bytes_of(&head));
        message.extend_from_slice(bytemuck::cast_slice(&self.ranges));
        message.extend_from_slice(&self.body);
        self.ranges.clear();
        self.body.clear();
        message
    }
}

fn head(message: &[u8]) -> Result<(Head, &[u8]), WireError> {
    let (head, rest) = message.split_at_checked(size_of::<Head>()).ok_or(WireError::Foreign)?;
    let head: Head = bytemuck::pod_read_unaligned(head);
    if head.magic != MAGIC {
        return Err(WireError::Foreign);
    }
    Ok((head, rest))
}

fn check(expected: u32, hasher: crc32fast::Hasher) -> Result<(), WireError> {
    let got = hasher.finalize();
    if got == expected { Ok(()) } else { Err(WireError::Checksum { expected, got }) }
}

/// Reads a message of segments into `buffer`, whose layout determines their size. Calls `take` with
/// `None` for each range, then with each of its segments. The message is verified first, except
/// for the segments' blocks.
///
/// # Errors
/// It is not a message of segments, or it is damaged.
pub fn read_batch(
    message: &[u8],
    buffer: &mut Segment,
    mut take: impl FnMut(&SegmentRange, Option<&Segment>),
) -> Result<(), WireError> {
    let (head, rest) = head(message)?;
    let length = |expected: usize| WireError::Length { expected, got: message.len() };
    let table = (head.count as usize).saturating_mul(size_of::<SegmentRange>());
    let (table, body) = rest.split_at_checked(table).ok_or_else(|| length(table))?;
    let ranges = table
        .chunks_exact(size_of::<SegmentRange>())
        .map(bytemuck::pod_read_unaligned::<SegmentRange>);
    let each = HEADER_BYTES + size_of_val(buffer.block.as_slice());
    let segments: u64 = ranges.clone().map(|range| u64::from(range.count)).sum();
    let expected = usize::try_from(segments).unwrap_or(usize::MAX).saturating_mul(each);
    if expected != body.len() {
        let around = message.len() - body.len();
        return Err(length(expected.saturating_add(around)));
    }
    let mut hasher = crc32fast::Hasher::new();
    body.chunks_exact(each).for_each(|segment| hasher.update(&segment[..HEADER_BYTES]));
    hasher.update(table);
    check(head.checksum, hasher)?;
    let mut segments = body.chunks_exact(each);
    for range in ranges {
        take(&range, None);
        for bytes in segments.by_ref().take(range.count as usize) {
            let (header, block) = bytes.split_at(HEADER_BYTES);
            buffer.header = bytemuck::pod_read_unaligned(header);
            bytemuck::cast_slice_mut(&mut buffer.block).copy_from_slice(block);
            take(&range, Some(buffer));
        }
    }
    Ok(())
}

/// Writes a message with the acknowledgements to a host's workers.
#[must_use]
pub fn write_acks(run_state: RunState, acks: &[LinkAck]) -> Vec<u8> {
    let body: &[u8] = bytemuck::cast_slice(acks);
    let count = u32::try_from(acks.len()).unwrap_or(u32::MAX);
    let (checksum, run_state) = (crc32fast::hash(body), run_state.number());
    let head = Head { magic: MAGIC, count, checksum, run_state };
    [bytemuck::bytes_of(&head), body].concat()
}

/// Reads a message with the acknowledgements to a host's workers.
///
/// # Errors
/// It is not such a message, or it is damaged.
pub fn read_acks(message: &[u8]) -> Result<(RunState, Vec<LinkAck>), WireError> {
    let (head, body) = head(message)?;
    let expected = (head.count as usize).saturating_mul(size_of::<LinkAck>());
    if expected != body.len() {
        let expected = expected.saturating_add(size_of::<Head>());
        return Err(WireError::Length { expected, got: message.len() });
    }
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(body);
    check(head.checksum, hasher)?;
    let acks = body.chunks_exact(size_of::<LinkAck>()).map(bytemuck::pod_read_unaligned);
    Ok((RunState::of(head.run_state), acks.collect()))
}

/// Writes a policy snapshot.
#[must_use]
pub fn write_snapshot(snapshot: &ParameterSnapshot) -> Vec<u8> {
    let values: &[u8] = bytemuck::cast_slice(&snapshot.values);
    let count = u32::try_from(snapshot.values.len()).unwrap_or(u32::MAX);
    let head = Head { magic: MAGIC, count, checksum: snapshot.checksum(), run_state: 0 };
    let ParameterSnapshot { version, env_steps, architecture_hash, settled, .. } = *snapshot;
    let words = [version, env_steps, architecture_hash, settled.into()];
    [bytemuck::bytes_of(&head), bytemuck::cast_slice(&words), values].concat()
}

/// Reads a policy snapshot.
///
/// # Errors
/// It is not a snapshot, or it is damaged.
pub fn read_snapshot(message: &[u8]) -> Result<ParameterSnapshot, WireError> {
    const WORDS: usize = 4 * size_of::<u64>();
    let (head, rest) = head(message)?;
    let expected = (head.count as usize).saturating_mul(size_of::<f32>()).saturating_add(WORDS);
    if expected != rest.len() {
        let expected = expected.saturating_add(size_of::<Head>());
        return Err(WireError::Length { expected, got: message.len() });
    }
    let (words, values) = rest.split_at(WORDS);
    let [version, env_steps, architecture_hash, settled]: [u64; 4] =
        bytemuck::pod_read_unaligned(words);
    let (settled, values) = (settled != 0, bytemuck::pod_collect_to_vec(values));
    let snapshot = ParameterSnapshot { version, env_steps, architecture_hash, settled, values };
    let (expected, got) = (head.checksum, snapshot.checksum());
    if got != expected {
        return Err(WireError::Checksum { expected, got });
    }
    Ok(snapshot)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn segment(sequence: u64) -> Segment {
        let header = SegmentHeader { sequence, worker_id: 3, ..SegmentHeader::default() };
        Segment { header, block: vec![sequence as f32, 0.5, -1.0] }
    }

    fn batch() -> Vec<u8> {
        let mut batch = Batch::default();
        batch.begin(SegmentRange { worker: 2, oldest: 7, start: 9, ..SegmentRange::default() });
        batch.begin(SegmentRange {
            worker: 3,
            oldest: 1,
            start: 4,
            retransmit_epoch: 5,
            ..SegmentRange::default()
        });
        [4, 5].map(segment).iter().for_each(|segment| batch.add(&segment.header, &segment.block));
        let message = batch.take();
        assert!(batch.is_empty());
        message
    }

    fn read(message: &[u8]) -> Result<Vec<(SegmentRange, Option<Segment>)>, WireError> {
        let mut buffer = segment(0);
        let mut read = Vec::new();
        read_batch(message, &mut buffer, |range, segment| {
            read.push((*range, segment.cloned()));
        })?;
        Ok(read)
    }

    #[test]
    fn segments_round_trip_at_any_alignment() {
        let message = batch();
        let read_well = read(&message).unwrap();
        let counts: Vec<_> = read_well.iter().map(|(range, _)| range.count).collect();
        assert_eq!(counts, [0, 2, 2, 2]);
        assert_eq!(read_well[2].1, Some(segment(4)));
        assert_eq!(read_well[3].1, Some(segment(5)));
        let shifted = [&[0][..], &message].concat();
        assert_eq!(read(&shifted[1..]).unwrap(), read_well);
    }

    #[test]
    fn a_truncated_damaged_or_foreign_message_is_rejected_as_a_whole() {
        let message = batch();
        for len in 0..message.len() {
            assert!(read(&message[..len]).is_err(), "cut at {len}");
        }
        // The learner detects damage of a block: here the last 12 bytes.
        for at in 0..message.len() - 12 {
            let mut damaged = message.clone();
            damaged[at] ^= 1;
            let block = (16 + 64 + 80..16 + 64 + 92).contains(&at);
            let unused = (12..16).contains(&at);
            assert_eq!(read(&damaged).is_err(), !block && !unused, "byte {at}");
        }
        assert_eq!(read(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"), Err(WireError::Foreign));
    }

    #[test]
    fn acks_and_snapshots_round_trip_or_are_rejected() {
        let first = LinkAck {
            sequence: 9,
            received: 11,
            incarnation: 2,
            rejected_epoch: 1,
            ..LinkAck::default()
        };
        let acks = [first, LinkAck::default()];
        let message = write_acks(RunState::Stopped, &acks);
        assert_eq!(read_acks(&message), Ok((RunState::Stopped, acks.to_vec())));
        let snapshot = ParameterSnapshot {
            version: 4,
            env_steps: 100,
            architecture_hash: 7,
            settled: true,
            values: vec![0.25, -3.0],
        };
        let written = write_snapshot(&snapshot);
        assert_eq!(read_snapshot(&written), Ok(snapshot));
        for message in [&message, &written] {
            for len in 0..message.len() {
                assert!(read_acks(&message[..len]).is_err());
                assert!(read_snapshot(&message[..len]).is_err());
            }
        }
    }
}
