//! Messages between relay and gateway, as bytes.
//!
//! Segments are sent as they are in shared memory, header and block, in *stretches*: consecutive
//! segments of one worker. The head reveals a different layout, a different byte order or damage.
//! The learner verifies the checksum of each block, as with any worker.
//!
//! Small and rare messages (joining, a host's status) are JSON.

use bytemuck::{Pod, Zeroable};
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::segment::{Segment, SegmentHeader};
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::{Mark, Sent};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::control::{Greeting, WorkersNow};

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
    /// Number of stretches or workers.
    count: u32,
    /// CRC-32 of the rest of the message, without the segments' blocks.
    checksum: u32,
    /// From a gateway a [`Course`]; from a host 0.
    course: u32,
}

/// Consecutive segments of one worker; without segments it only reports the worker's progress.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct Stretch {
    /// The oldest segment that the host retains: all earlier ones are acknowledged.
    pub first: u64,
    /// Sequence number of the first segment of this stretch, or of the next one to be sent.
    pub next: u64,
    /// Index of the worker in the run.
    pub worker: u32,
    /// Incarnation of the worker.
    pub incarnation: u32,
    /// Number of times that the worker's retained segments were sent again.
    pub attempt: u32,
    /// Number of segments that follow.
    pub count: u32,
}

/// The state of one worker at the gateway and at the learner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct Hearing {
    /// The learner has acknowledged all segments up to this sequence number.
    pub sequence: u64,
    /// The gateway has received all segments up to this sequence number.
    pub landed: u64,
    /// Incarnation to which `sequence` belongs.
    pub incarnation: u32,
    /// Incarnation to which `landed` belongs.
    pub landed_incarnation: u32,
    /// Attempt in which a segment was missing, so that the host must retransmit; 0 if none.
    pub refused: u32,
    /// Padding of the last word.
    pub reserved: u32,
}

impl Hearing {
    /// The learner's last acknowledgement.
    #[must_use]
    pub fn mark(&self) -> Mark {
        Mark { incarnation: self.incarnation, sequence: self.sequence }
    }
}

/// State of a run, as reported to the hosts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Course {
    /// The run continues.
    On,
    /// The run is complete.
    Complete,
    /// The run was stopped and may be resumed.
    Stopped,
    /// The run continues without this host, which has left.
    Left,
}

impl Course {
    fn of(number: u32) -> Self {
        match number {
            1 => Self::Complete,
            2 => Self::Stopped,
            3 => Self::Left,
            _ => Self::On,
        }
    }

    fn number(self) -> u32 {
        match self {
            Self::On => 0,
            Self::Complete => 1,
            Self::Stopped => 2,
            Self::Left => 3,
        }
    }
}

/// A message of segments under construction.
#[derive(Debug, Default)]
pub struct Batch {
    stretches: Vec<Stretch>,
    body: Vec<u8>,
    headers: crc32fast::Hasher,
}

impl Batch {
    /// Begins a stretch, to which the next segments belong.
    pub fn begin(&mut self, stretch: Stretch) {
        self.stretches.push(Stretch { count: 0, ..stretch });
    }

    /// Adds a segment to the current stretch.
    ///
    /// # Panics
    /// Without a current stretch.
    pub fn add(&mut self, header: &SegmentHeader, block: &[f32]) {
        let stretch = self.stretches.last_mut();
        stretch.expect("a segment belongs to a stretch").count += 1;
        self.headers.update(bytemuck::bytes_of(header));
        self.body.extend_from_slice(bytemuck::bytes_of(header));
        self.body.extend_from_slice(bytemuck::cast_slice(block));
    }

    /// Size of the segments so far in bytes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.body.len()
    }

    /// Returns true if no stretch has begun.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.stretches.is_empty()
    }

    /// Finishes the message; the batch is empty afterwards.
    pub fn take(&mut self) -> Vec<u8> {
        let mut hasher = std::mem::take(&mut self.headers);
        hasher.update(bytemuck::cast_slice(&self.stretches));
        let count = u32::try_from(self.stretches.len()).unwrap_or(u32::MAX);
        let head = Head { magic: MAGIC, count, checksum: hasher.finalize(), course: 0 };
        let table = size_of_val(self.stretches.as_slice());
        let mut message = Vec::with_capacity(size_of::<Head>() + table + self.body.len());
        message.extend_from_slice(bytemuck::bytes_of(&head));
        message.extend_from_slice(bytemuck::cast_slice(&self.stretches));
        message.extend_from_slice(&self.body);
        self.stretches.clear();
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
/// `None` for each stretch, then with each of its segments. The message is verified first, except
/// for the segments' blocks.
///
/// # Errors
/// It is not a message of segments, or it is damaged.
pub fn read_batch(
    message: &[u8],
    buffer: &mut Segment,
    mut take: impl FnMut(&Stretch, Option<&Segment>),
) -> Result<(), WireError> {
    let (head, rest) = head(message)?;
    let length = |expected: usize| WireError::Length { expected, got: message.len() };
    let table = (head.count as usize).saturating_mul(size_of::<Stretch>());
    let (table, body) = rest.split_at_checked(table).ok_or_else(|| length(table))?;
    let stretches =
        table.chunks_exact(size_of::<Stretch>()).map(bytemuck::pod_read_unaligned::<Stretch>);
    let each = HEADER_BYTES + size_of_val(buffer.block.as_slice());
    let segments: u64 = stretches.clone().map(|stretch| u64::from(stretch.count)).sum();
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
    for stretch in stretches {
        take(&stretch, None);
        for bytes in segments.by_ref().take(stretch.count as usize) {
            let (header, block) = bytes.split_at(HEADER_BYTES);
            buffer.header = bytemuck::pod_read_unaligned(header);
            bytemuck::cast_slice_mut(&mut buffer.block).copy_from_slice(block);
            take(&stretch, Some(buffer));
        }
    }
    Ok(())
}

/// Writes a message with the state of a host's workers.
#[must_use]
pub fn write_hearings(course: Course, hearings: &[Hearing]) -> Vec<u8> {
    let body: &[u8] = bytemuck::cast_slice(hearings);
    let count = u32::try_from(hearings.len()).unwrap_or(u32::MAX);
    let (checksum, course) = (crc32fast::hash(body), course.number());
    let head = Head { magic: MAGIC, count, checksum, course };
    [bytemuck::bytes_of(&head), body].concat()
}

/// Reads a message with the state of a host's workers.
///
/// # Errors
/// It is not such a message, or it is damaged.
pub fn read_hearings(message: &[u8]) -> Result<(Course, Vec<Hearing>), WireError> {
    let (head, body) = head(message)?;
    let expected = (head.count as usize).saturating_mul(size_of::<Hearing>());
    if expected != body.len() {
        let expected = expected.saturating_add(size_of::<Head>());
        return Err(WireError::Length { expected, got: message.len() });
    }
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(body);
    check(head.checksum, hasher)?;
    let hearings = body.chunks_exact(size_of::<Hearing>()).map(bytemuck::pod_read_unaligned);
    Ok((Course::of(head.course), hearings.collect()))
}

/// Writes a policy snapshot.
#[must_use]
pub fn write_snapshot(snapshot: &ParameterSnapshot) -> Vec<u8> {
    let values: &[u8] = bytemuck::cast_slice(&snapshot.values);
    let count = u32::try_from(snapshot.values.len()).unwrap_or(u32::MAX);
    let head = Head { magic: MAGIC, count, checksum: snapshot.checksum(), course: 0 };
    let words = [snapshot.version, snapshot.env_steps, snapshot.architecture_hash];
    [bytemuck::bytes_of(&head), bytemuck::cast_slice(&words), values].concat()
}

/// Reads a policy snapshot.
///
/// # Errors
/// It is not a snapshot, or it is damaged.
pub fn read_snapshot(message: &[u8]) -> Result<ParameterSnapshot, WireError> {
    const WORDS: usize = 3 * size_of::<u64>();
    let (head, rest) = head(message)?;
    let expected = (head.count as usize).saturating_mul(size_of::<f32>()).saturating_add(WORDS);
    if expected != rest.len() {
        let expected = expected.saturating_add(size_of::<Head>());
        return Err(WireError::Length { expected, got: message.len() });
    }
    let (words, values) = rest.split_at(WORDS);
    let [version, env_steps, architecture_hash] = bytemuck::pod_read_unaligned(words);
    let values = bytemuck::pod_collect_to_vec(values);
    let snapshot = ParameterSnapshot { version, env_steps, architecture_hash, values };
    let (expected, got) = (head.checksum, snapshot.checksum());
    if got != expected {
        return Err(WireError::Checksum { expected, got });
    }
    Ok(snapshot)
}

/// A host's request to join.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostRequest {
    /// Program and version of the host.
    pub speaks: Greeting,
    /// Token of the run.
    pub token: String,
    /// Random number that identifies this start of `dmprl bridge`.
    pub host: u64,
    /// Name of the host, for display.
    pub name: String,
    /// Number of workers.
    pub workers: u32,
    /// Previous places, if the host returns.
    pub held: Option<Held>,
}

/// The places of a host.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Held {
    /// Index of its first worker in the run.
    pub first: u32,
    /// Session of the run from which its workers' incarnations are derived.
    pub session: u32,
}

/// Answer to a request to join.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum HostAnswer {
    /// The host is admitted.
    Welcome(Box<HostWelcome>),
    /// The host is rejected.
    Refused {
        /// The reason and a remedy.
        reason: String,
        /// True if a later request may succeed.
        later: bool,
    },
}

/// Everything that an admitted host needs to know.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostWelcome {
    /// Secret part of the names of the messages between this host and the gateway.
    pub seat: u64,
    /// Id of the gateway. Its successor does not know the seat.
    pub gateway: u64,
    /// Places of the host.
    pub held: Held,
    /// Run id, as in the manifest.
    pub run_id: String,
    /// Configuration, as in the run's `config.toml`.
    pub config: String,
    /// Spec of the run's environment.
    pub spec: EnvSpec,
}

/// Status of a host, sent several times per second.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostStatus {
    /// Version of its policy.
    pub policy_version: u64,
    /// Counts of its workers' segments since the host began.
    pub sent: Sent,
    /// Number of failures of environments since the host began.
    pub env_failures: u64,
    /// State of its workers.
    pub workers: WorkersNow,
    /// True if it leaves.
    pub leaves: bool,
}

impl HostStatus {
    /// Raises counts to those of the previous status. A restarted relay reports none until its
    /// supervisor has sent them, and counters must not decrease.
    pub fn no_less_than(&mut self, before: &Self) {
        let (now, then) = (&self.sent, &before.sent);
        let less = now.produced < then.produced
            || now.sent < then.sent
            || now.resent < then.resent
            || now.acked < then.acked
            || self.env_failures < before.env_failures;
        if less {
            (self.sent, self.env_failures) = (before.sent, before.env_failures);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_of_a_host_never_fall() {
        let of = |produced, env_failures| HostStatus {
            sent: Sent { produced, sent: 2, ..Sent::default() },
            env_failures,
            ..HostStatus::default()
        };
        let before = of(5, 1);
        let mut status = HostStatus { policy_version: 9, ..HostStatus::default() };
        status.no_less_than(&before);
        assert_eq!(status, HostStatus { policy_version: 9, ..before.clone() });
        let mut more = of(6, 1);
        more.no_less_than(&before);
        assert_eq!(more, of(6, 1));
    }

    fn segment(sequence: u64) -> Segment {
        let header = SegmentHeader { sequence, worker_id: 3, ..SegmentHeader::default() };
        Segment { header, block: vec![sequence as f32, 0.5, -1.0] }
    }

    fn batch() -> Vec<u8> {
        let mut batch = Batch::default();
        batch.begin(Stretch { worker: 2, first: 7, next: 9, ..Stretch::default() });
        batch.begin(Stretch { worker: 3, first: 1, next: 4, attempt: 5, ..Stretch::default() });
        [4, 5].map(segment).iter().for_each(|segment| batch.add(&segment.header, &segment.block));
        let message = batch.take();
        assert!(batch.is_empty());
        message
    }

    fn read(message: &[u8]) -> Result<Vec<(Stretch, Option<Segment>)>, WireError> {
        let mut buffer = segment(0);
        let mut read = Vec::new();
        read_batch(message, &mut buffer, |stretch, segment| {
            read.push((*stretch, segment.cloned()));
        })?;
        Ok(read)
    }

    #[test]
    fn segments_come_out_as_they_went_in_wherever_the_message_lies() {
        let message = batch();
        let read_well = read(&message).unwrap();
        let counts: Vec<_> = read_well.iter().map(|(stretch, _)| stretch.count).collect();
        assert_eq!(counts, [0, 2, 2, 2]);
        assert_eq!(read_well[2].1, Some(segment(4)));
        assert_eq!(read_well[3].1, Some(segment(5)));
        let shifted = [&[0][..], &message].concat();
        assert_eq!(read(&shifted[1..]).unwrap(), read_well);
    }

    #[test]
    fn what_is_cut_damaged_or_foreign_is_refused_before_anything_is_taken() {
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
    fn hearings_and_snapshots_come_out_as_they_went_in_or_not_at_all() {
        let first =
            Hearing { sequence: 9, landed: 11, incarnation: 2, refused: 1, ..Hearing::default() };
        let hearings = [first, Hearing::default()];
        let message = write_hearings(Course::Stopped, &hearings);
        assert_eq!(read_hearings(&message), Ok((Course::Stopped, hearings.to_vec())));
        let snapshot = ParameterSnapshot {
            version: 4,
            env_steps: 100,
            architecture_hash: 7,
            values: vec![0.25, -3.0],
        };
        let written = write_snapshot(&snapshot);
        assert_eq!(read_snapshot(&written), Ok(snapshot));
        for message in [&message, &written] {
            for len in 0..message.len() {
                assert!(read_hearings(&message[..len]).is_err());
                assert!(read_snapshot(&message[..len]).is_err());
            }
        }
    }
}
