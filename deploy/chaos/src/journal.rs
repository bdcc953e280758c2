//! Journals of workers and learners during `dmprl chaos`: one file per process, one record per
//! event.
//!
//! ```text
//!   record: kind · worker · incarnation · checksum · three numbers · time · CRC-32 of the rest
//! ```
//! Each record is written with one unbuffered `write`, so that SIGKILL loses no written record. The
//! last record of a killed process may be incomplete. Without `--journal`, no journal is written.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use bytemuck::{Pod, Zeroable};
use dmprl_learner::learner::Counters;
use dmprl_shared::segment::SegmentHeader;
use dmprl_shared::transport::delivery::Watermark;
use rustix::time::{ClockId, clock_gettime};

/// A learner's counters of inserted segments and updates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LearnerCounters {
    /// Environment steps inserted.
    pub env_steps: u64,
    /// Updates done.
    pub updates: u64,
    /// Segments inserted.
    pub segments: u64,
}

impl From<&Counters> for LearnerCounters {
    fn from(counters: &Counters) -> Self {
        let Counters { env_steps, updates, segments, .. } = *counters;
        Self { env_steps, updates, segments }
    }
}

/// Identity and checksum of a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SegmentDigest {
    /// Index of the worker.
    pub worker: u32,
    /// Incarnation and sequence number.
    pub mark: Watermark,
    /// CRC-32 of header and block, computed independently by worker and learner.
    pub checksum: u32,
    /// Environment steps in the segment.
    pub env_steps: u64,
}

impl SegmentDigest {
    /// Computes the digest of a segment.
    #[must_use]
    pub fn of(header: &SegmentHeader, block: &[f32]) -> Self {
        let mut checksum = crc32fast::Hasher::new();
        checksum.update(bytemuck::bytes_of(header));
        checksum.update(bytemuck::cast_slice(block));
        Self {
            worker: header.worker_id,
            mark: Watermark { incarnation: header.incarnation, sequence: header.sequence },
            checksum: checksum.finalize(),
            env_steps: header.steps_len.into(),
        }
    }
}

/// An event in the journal of a worker or learner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Entry {
    /// A worker has finished a segment, but not yet put it into its outbox.
    Produced(SegmentDigest),
    /// A worker has dropped its acknowledged segments up to this mark.
    Acknowledged(Watermark),
    /// A worker has adopted a policy.
    Policy {
        /// Number of the learner within the session.
        epoch: u64,
        /// Version of the policy.
        version: u64,
    },
    /// A learner starts, having settled this worker's segments up to the mark.
    Restored(u32, Watermark),
    /// The starting learner's counters, after one [`Entry::Restored`] per worker.
    Started(LearnerCounters),
    /// The learner has read its log, and now receives segments from workers.
    Serving,
    /// A learner has inserted a segment, from a worker or from its log.
    Inserted(SegmentDigest),
    /// A learner has rejected a segment.
    Rejected {
        /// The segment.
        segment: SegmentDigest,
        /// True if it was rejected as a duplicate.
        is_duplicate: bool,
    },
    /// A learner begins a checkpoint with these counters.
    CheckpointBegun(LearnerCounters),
}

/// An event and its time [us of the monotonic clock, which all processes share].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Record {
    /// The event.
    pub entry: Entry,
    /// Time of the event.
    pub time_us: u64,
}

/// Size of a record in bytes.
pub const RECORD_BYTES: usize = size_of::<RawRecord>();

#[derive(Debug, Clone, Copy, Default, Pod, Zeroable)]
#[repr(C)]
struct RawRecord {
    kind: u32,
    worker: u32,
    incarnation: u32,
    checksum: u32,
    numbers: [u64; 3],
    time_us: u64,
    reserved: u32,
    crc32: u32,
}

const CRC_BYTES: usize = size_of::<u32>();

impl RawRecord {
    /// CRC-32 of all other fields.
    fn compute_crc32(&self) -> u32 {
        crc32fast::hash(&bytemuck::bytes_of(self)[..RECORD_BYTES - CRC_BYTES])
    }

    fn segment(kind: u32, segment: &SegmentDigest) -> Self {
        let SegmentDigest { worker, mark, checksum, env_steps } = *segment;
        let numbers = [mark.sequence, env_steps, 0];
        Self { kind, worker, incarnation: mark.incarnation, checksum, numbers, ..Self::default() }
    }

    fn counters(kind: u32, counters: &LearnerCounters) -> Self {
        let LearnerCounters { env_steps, updates, segments } = *counters;
        Self { kind, numbers: [env_steps, updates, segments], ..Self::default() }
    }

    fn as_mark(&self) -> Watermark {
        Watermark { incarnation: self.incarnation, sequence: self.numbers[0] }
    }

    fn as_segment(&self) -> SegmentDigest {
        let Self { worker, checksum, numbers: [_, env_steps, _], .. } = *self;
        SegmentDigest { worker, mark: self.as_mark(), checksum, env_steps }
    }

    fn as_counters(&self) -> LearnerCounters {
        let [env_steps, updates, segments] = self.numbers;
        LearnerCounters { env_steps, updates, segments }
    }
}

impl Record {
    /// Encodes the record for a file.
    #[must_use]
    pub fn encode(&self) -> [u8; RECORD_BYTES] {
        let marked = |kind, worker, mark: &Watermark| RawRecord {
            kind,
            worker,
            incarnation: mark.incarnation,
            numbers: [mark.sequence, 0, 0],
            ..RawRecord::default()
        };
        let raw = match &self.entry {
            Entry::Produced(segment) => RawRecord::segment(1, segment),
            Entry::Acknowledged(mark) => marked(2, 0, mark),
            Entry::Policy { epoch, version } => {
                RawRecord { kind: 3, numbers: [*epoch, *version, 0], ..RawRecord::default() }
            }
            Entry::Restored(worker, mark) => marked(4, *worker, mark),
            Entry::Started(counters) => RawRecord::counters(5, counters),
            Entry::Serving => RawRecord { kind: 6, ..RawRecord::default() },
            Entry::Inserted(segment) => RawRecord::segment(7, segment),
            Entry::Rejected { segment, is_duplicate } => {
                RawRecord::segment(8 + u32::from(*is_duplicate), segment)
            }
            Entry::CheckpointBegun(counters) => RawRecord::counters(10, counters),
        };
        let mut raw = RawRecord { time_us: self.time_us, ..raw };
        raw.crc32 = raw.compute_crc32();
        let mut bytes = [0; RECORD_BYTES];
        bytes.copy_from_slice(bytemuck::bytes_of(&raw));
        bytes
    }

    /// Decodes a record. Returns `None` if it is invalid.
    #[must_use]
    pub fn decode(bytes: &[u8; RECORD_BYTES]) -> Option<Self> {
        let raw: RawRecord = bytemuck::pod_read_unaligned(bytes);
        let entry = match raw.kind {
            _ if raw.crc32 != raw.compute_crc32() => return None,
            1 => Entry::Produced(raw.as_segment()),
            2 => Entry::Acknowledged(raw.as_mark()),
            3 => Entry::Policy { epoch: raw.numbers[0], version: raw.numbers[1] },
            4 => Entry::Restored(raw.worker, raw.as_mark()),
            5 => Entry::Started(raw.as_counters()),
            6 => Entry::Serving,
            7 => Entry::Inserted(raw.as_segment()),
            8 => Entry::Rejected { segment: raw.as_segment(), is_duplicate: false },
            9 => Entry::Rejected { segment: raw.as_segment(), is_duplicate: true },
            10 => Entry::CheckpointBegun(raw.as_counters()),
            _ => return None,
        };
        Some(Self { entry, time_us: raw.time_us })
    }
}

/// Returns the time of the monotonic clock \[us\], which all processes of a machine share.
#[must_use]
pub fn now_us() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    // Time since boot, never negative.
    (now.tv_sec * 1_000_000 + now.tv_nsec / 1_000).unsigned_abs()
}

/// The process that writes a journal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Author {
    /// A worker, by index and incarnation.
    Worker(u32, u32),
    /// A learner, by the number of learner deaths before it.
    Learner(u64),
}

impl Author {
    /// Returns the path of this process's journal in a folder.
    #[must_use]
    pub fn path(&self, folder: &Path) -> PathBuf {
        folder.join(match self {
            Self::Worker(index, incarnation) => format!("actor-{index}-{incarnation}"),
            Self::Learner(deaths) => format!("learner-{deaths}"),
        })
    }

    /// Parses the author from a journal's file name.
    #[must_use]
    pub fn of(name: &str) -> Option<Self> {
        let mut parts = name.split('-');
        let author = match (parts.next()?, parts.next()?, parts.next()) {
            ("learner", deaths, None) => Self::Learner(deaths.parse().ok()?),
            ("actor", index, Some(incarnation)) => {
                Self::Worker(index.parse().ok()?, incarnation.parse().ok()?)
            }
            _ => return None,
        };
        parts.next().is_none().then_some(author)
    }
}

/// A journal open for writing.
#[derive(Debug, Clone)]
pub struct Journal(Arc<File>);

impl Journal {
    /// Creates a journal in a folder. Returns `None` without a folder.
    ///
    /// # Errors
    /// The file cannot be created, or already exists.
    pub fn open(folder: Option<&Path>, author: Author) -> anyhow::Result<Option<Self>> {
        let Some(folder) = folder else { return Ok(None) };
        let path = author.path(folder);
        let file = OpenOptions::new().append(true).create_new(true).mode(0o600).open(&path);
        let file = file.with_context(|| format!("cannot make the journal {}", path.display()))?;
        Ok(Some(Self(Arc::new(file))))
    }

    /// Appends an entry with the current time.
    ///
    /// # Panics
    /// If the write fails: without the entry, the checker would report false violations.
    pub fn note(&self, entry: Entry) {
        let written = (&*self.0).write_all(&Record { entry, time_us: now_us() }.encode());
        assert!(written.is_ok(), "cannot write the journal: {written:?}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_round_trip_and_corrupt_ones_are_rejected() {
        let mark = Watermark { incarnation: 3, sequence: 1 << 40 };
        let segment = SegmentDigest { worker: 7, mark, checksum: 0xdead_beef, env_steps: 5 };
        let counters = LearnerCounters { env_steps: 1, updates: 2, segments: 3 };
        let entries = [
            Entry::Produced(segment),
            Entry::Acknowledged(mark),
            Entry::Policy { epoch: 4, version: 9 },
            Entry::Restored(7, mark),
            Entry::Started(counters),
            Entry::Serving,
            Entry::Inserted(segment),
            Entry::Rejected { segment, is_duplicate: false },
            Entry::Rejected { segment, is_duplicate: true },
            Entry::CheckpointBegun(counters),
        ];
        for entry in entries {
            let record = Record { entry, time_us: 12 };
            let mut bytes = record.encode();
            assert_eq!(Record::decode(&bytes), Some(record));
            for at in 0..bytes.len() {
                bytes[at] ^= 1;
                assert_eq!(Record::decode(&bytes), None, "byte {at} of {entry:?}");
                bytes[at] ^= 1;
            }
        }
    }

    #[test]
    fn author_round_trips_through_the_file_name() {
        for author in [Author::Worker(3, 65_536), Author::Learner(12)] {
            let path = author.path(Path::new("folder"));
            assert_eq!(Author::of(path.file_name().unwrap().to_str().unwrap()), Some(author));
        }
        for name in ["", "learner", "actor-1", "actor-1-2-3", "learner-x", "evaluator-1"] {
            assert_eq!(Author::of(name), None, "{name}");
        }
    }
}
