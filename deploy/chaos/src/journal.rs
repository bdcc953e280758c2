//! Journals of workers and learners during `dmprl chaos`: one file per process, one record per
//! event.
//!
//! ```text
//!   record: kind · worker · incarnation · checksum · three numbers · time · CRC-32 of all that
//! ```
//! Each record is written by one plain `write`, so that SIGKILL loses no written record; the last
//! record of a killed process may be incomplete. Without `--journal` no journal is written.

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

/// Counters of a learner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Standing {
    /// Environment steps inserted.
    pub env_steps: u64,
    /// Updates done.
    pub updates: u64,
    /// Segments inserted.
    pub segments: u64,
}

impl From<&Counters> for Standing {
    fn from(counters: &Counters) -> Self {
        let Counters { env_steps, updates, segments, .. } = *counters;
        Self { env_steps, updates, segments }
    }
}

/// Identity and checksum of a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Piece {
    /// Index of the worker.
    pub worker: u32,
    /// Incarnation and sequence number.
    pub mark: Watermark,
    /// CRC-32 of header and block, computed at each end.
    pub checksum: u32,
    /// Environment steps in the segment.
    pub env_steps: u64,
}

impl Piece {
    /// Describes a segment, computing its checksum.
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

/// An event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Entry {
    /// A worker has finished a segment, but not yet retained or offered it.
    Produced(Piece),
    /// A worker has dropped its segments up to this mark.
    Acknowledged(Watermark),
    /// A worker has taken a policy.
    Policy {
        /// Number of the learner in the session.
        epoch: u64,
        /// Version of the policy.
        version: u64,
    },
    /// A learner starts; it has settled this worker's segments up to the mark.
    Restored(u32, Watermark),
    /// Its counters, after one [`Entry::Restored`] per worker.
    Started(Standing),
    /// It has read its log, and now takes segments from workers.
    Serving,
    /// A learner has inserted a segment, from a worker or from its log.
    Inserted(Piece),
    /// It has rejected a segment; true if it was a duplicate.
    Refused(Piece, bool),
    /// It begins a checkpoint.
    Cut(Standing),
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
pub const RECORD_BYTES: usize = size_of::<Raw>();

#[derive(Debug, Clone, Copy, Default, Pod, Zeroable)]
#[repr(C)]
struct Raw {
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

impl Raw {
    fn sum(&self) -> u32 {
        crc32fast::hash(&bytemuck::bytes_of(self)[..RECORD_BYTES - CRC_BYTES])
    }

    fn piece(kind: u32, piece: &Piece) -> Self {
        let Piece { worker, mark, checksum, env_steps } = *piece;
        let numbers = [mark.sequence, env_steps, 0];
        Self { kind, worker, incarnation: mark.incarnation, checksum, numbers, ..Self::default() }
    }

    fn standing(kind: u32, standing: &Standing) -> Self {
        let Standing { env_steps, updates, segments } = *standing;
        Self { kind, numbers: [env_steps, updates, segments], ..Self::default() }
    }

    fn as_mark(&self) -> Watermark {
        Watermark { incarnation: self.incarnation, sequence: self.numbers[0] }
    }

    fn as_piece(&self) -> Piece {
        let Self { worker, checksum, numbers: [_, env_steps, _], .. } = *self;
        Piece { worker, mark: self.as_mark(), checksum, env_steps }
    }

    fn as_standing(&self) -> Standing {
        let [env_steps, updates, segments] = self.numbers;
        Standing { env_steps, updates, segments }
    }
}

impl Record {
    /// Encodes the record for a file.
    #[must_use]
    pub fn encode(&self) -> [u8; RECORD_BYTES] {
        let marked = |kind, worker, mark: &Watermark| Raw {
            kind,
            worker,
            incarnation: mark.incarnation,
            numbers: [mark.sequence, 0, 0],
            ..Raw::default()
        };
        let raw = match &self.entry {
            Entry::Produced(piece) => Raw::piece(1, piece),
            Entry::Acknowledged(mark) => marked(2, 0, mark),
            Entry::Policy { epoch, version } => {
                Raw { kind: 3, numbers: [*epoch, *version, 0], ..Raw::default() }
            }
            Entry::Restored(worker, mark) => marked(4, *worker, mark),
            Entry::Started(standing) => Raw::standing(5, standing),
            Entry::Serving => Raw { kind: 6, ..Raw::default() },
            Entry::Inserted(piece) => Raw::piece(7, piece),
            Entry::Refused(piece, known) => Raw::piece(8 + u32::from(*known), piece),
            Entry::Cut(standing) => Raw::standing(10, standing),
        };
        let mut raw = Raw { time_us: self.time_us, ..raw };
        raw.crc32 = raw.sum();
        let mut bytes = [0; RECORD_BYTES];
        bytes.copy_from_slice(bytemuck::bytes_of(&raw));
        bytes
    }

    /// Decodes a record; `None` if it is incomplete or invalid.
    #[must_use]
    pub fn decode(bytes: &[u8; RECORD_BYTES]) -> Option<Self> {
        let raw: Raw = bytemuck::pod_read_unaligned(bytes);
        let entry = match raw.kind {
            _ if raw.crc32 != raw.sum() => return None,
            1 => Entry::Produced(raw.as_piece()),
            2 => Entry::Acknowledged(raw.as_mark()),
            3 => Entry::Policy { epoch: raw.numbers[0], version: raw.numbers[1] },
            4 => Entry::Restored(raw.worker, raw.as_mark()),
            5 => Entry::Started(raw.as_standing()),
            6 => Entry::Serving,
            7 => Entry::Inserted(raw.as_piece()),
            8 => Entry::Refused(raw.as_piece(), false),
            9 => Entry::Refused(raw.as_piece(), true),
            10 => Entry::Cut(raw.as_standing()),
            _ => return None,
        };
        Some(Self { entry, time_us: raw.time_us })
    }
}

/// Microseconds of the monotonic clock, which all processes of a machine share.
#[must_use]
pub fn now_us() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    // Since the machine started: never negative.
    (now.tv_sec * 1_000_000 + now.tv_nsec / 1_000).unsigned_abs()
}

/// Process that writes a journal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Author {
    /// A worker, by index and incarnation.
    Worker(u32, u32),
    /// A learner, by the number of deaths before it.
    Learner(u64),
}

impl Author {
    /// Path of its journal.
    #[must_use]
    pub fn path(&self, folder: &Path) -> PathBuf {
        folder.join(match self {
            Self::Worker(index, incarnation) => format!("actor-{index}-{incarnation}"),
            Self::Learner(deaths) => format!("learner-{deaths}"),
        })
    }

    /// Returns the author of a journal with this name.
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

/// The journal of a process, for writing.
#[derive(Debug, Clone)]
pub struct Journal(Arc<File>);

impl Journal {
    /// Creates an empty journal in a folder; returns `None` without a folder.
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

    /// Writes an entry.
    ///
    /// # Panics
    /// If it cannot be written, because the checker would report violations that never happened.
    pub fn note(&self, entry: Entry) {
        let written = (&*self.0).write_all(&Record { entry, time_us: now_us() }.encode());
        assert!(written.is_ok(), "cannot write the journal: {written:?}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_entry_is_read_as_it_was_written_and_a_torn_one_is_not_read() {
        let mark = Watermark { incarnation: 3, sequence: 1 << 40 };
        let piece = Piece { worker: 7, mark, checksum: 0xdead_beef, env_steps: 5 };
        let standing = Standing { env_steps: 1, updates: 2, segments: 3 };
        let entries = [
            Entry::Produced(piece),
            Entry::Acknowledged(mark),
            Entry::Policy { epoch: 4, version: 9 },
            Entry::Restored(7, mark),
            Entry::Started(standing),
            Entry::Serving,
            Entry::Inserted(piece),
            Entry::Refused(piece, false),
            Entry::Refused(piece, true),
            Entry::Cut(standing),
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
    fn an_author_is_read_from_the_name_of_its_file() {
        for author in [Author::Worker(3, 65_536), Author::Learner(12)] {
            let path = author.path(Path::new("folder"));
            assert_eq!(Author::of(path.file_name().unwrap().to_str().unwrap()), Some(author));
        }
        for name in ["", "learner", "actor-1", "actor-1-2-3", "learner-x", "evaluator-1"] {
            assert_eq!(Author::of(name), None, "{name}");
        }
    }
}
