//! The segment log: contains the segments settled since the last checkpoint, for a restarted
//! learner.
//!
//! ```text
//!   head:    magic "DMPRLSL1" · u64 run id, architecture hash, block length
//!   record:  u32 bytes of the payload, u32 CRC-32 of the payload, payload: header · block
//! ```
//! All numbers are little-endian, as in memory on every supported processor. Records are buffered
//! and appended with one `write`. They survive a crash of the process, but are not synced, so a
//! power failure can lose them. A process killed during a `write` leaves an incomplete record,
//! which was never acknowledged and is truncated. Once a checkpoint is on disk, the records that it
//! contains are removed from the log. A process killed between these two steps leaves records that
//! the checkpoint's marks identify as duplicates.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::segment::{Segment, SegmentHeader, SegmentLayout};

const MAGIC: &[u8; 8] = b"DMPRLSL1";
const HEAD_BYTES: usize = 32;
/// Size of the length and checksum before each payload.
const FRAME_BYTES: usize = 8;
/// Size of the buffer for records between two `write`s.
const BUFFER_BYTES: usize = 4 << 20;

/// Why the log cannot be used.
#[derive(Debug, Error)]
pub enum LogError {
    /// Reading or writing the file failed.
    #[error("segment log: {0}")]
    Io(#[from] io::Error),
    /// The log of another run, architecture or segment length.
    #[error("segment log: it belongs to another run or another configuration; remove the file")]
    Foreign,
}

/// Result of reading the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Replayed {
    /// Number of complete records.
    pub records: u64,
    /// Bytes after the last complete record, which were truncated.
    pub cut_bytes: u64,
}

/// The run and the architecture that a log belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LogIdentity {
    /// Run id.
    pub run_id: u64,
    /// Hash of the policy's architecture.
    pub architecture_hash: u64,
}

/// An open segment log. Only one process opens it.
#[derive(Debug)]
pub struct SegmentLog {
    path: PathBuf,
    file: File,
    layout: SegmentLayout,
    head: [u8; HEAD_BYTES],
    /// Bytes of complete records in the file.
    written: u64,
    /// Whether a `write` failed, so that the file may end with an incomplete record.
    torn: bool,
    buffer: Vec<u8>,
    bytes_max: u64,
}

impl SegmentLog {
    /// Opens the log of a run, or creates an empty one, for at most `bytes_max` bytes of records.
    ///
    /// # Errors
    /// `Foreign` if the file belongs to another run, architecture or segment length; `Io` if the
    /// file system returns an error.
    pub fn open(
        path: &Path,
        identity: LogIdentity,
        layout: SegmentLayout,
        bytes_max: u64,
    ) -> Result<Self, LogError> {
        let mut head = [0; HEAD_BYTES];
        head[..8].copy_from_slice(MAGIC);
        let LogIdentity { run_id, architecture_hash } = identity;
        let numbers = [run_id, architecture_hash, layout.block_len() as u64];
        for (bytes, number) in head[8..].chunks_exact_mut(8).zip(numbers) {
            bytes.copy_from_slice(&number.to_le_bytes());
        }
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(false).mode(0o600);
        let file = options.open(path)?;
        let buffer = Vec::with_capacity(BUFFER_BYTES);
        let path = path.to_owned();
        let mut log = Self { path, file, layout, head, written: 0, torn: false, buffer, bytes_max };
        let mut found = Vec::new();
        (&log.file).take(HEAD_BYTES as u64).read_to_end(&mut found)?;
        if found.len() < HEAD_BYTES {
            // A process was killed before it had written the whole head, so there are no records.
            log.file.set_len(0)?;
            log.file.rewind()?;
            log.file.write_all(&log.head)?;
        } else if found != log.head {
            return Err(LogError::Foreign);
        }
        Ok(log)
    }

    /// Passes every complete record to `each`, oldest first, and truncates the file after the last
    /// one.
    ///
    /// # Errors
    /// `Io` if the file system returns an error.
    pub fn replay(&mut self, mut each: impl FnMut(&Segment)) -> Result<Replayed, LogError> {
        let len = self.file.metadata()?.len().saturating_sub(HEAD_BYTES as u64);
        self.file.seek(SeekFrom::Start(HEAD_BYTES as u64))?;
        let mut replayed = Replayed::default();
        let mut segment = Segment::zeroed(self.layout);
        let mut record = vec![0; self.record_bytes()];
        let mut input = io::BufReader::with_capacity(1 << 20, &self.file);
        self.written = 0;
        while self.written + record.len() as u64 <= len {
            input.read_exact(&mut record)?;
            if !decode(&record, &mut segment) {
                break;
            }
            each(&segment);
            replayed.records += 1;
            self.written += record.len() as u64;
        }
        replayed.cut_bytes = len - self.written;
        self.cut()?;
        Ok(replayed)
    }

    /// Whether another segment can be appended now. If not, and the log is not full, the next
    /// `write` makes room.
    #[must_use]
    pub fn has_room(&self) -> bool {
        // A record that is larger than the buffer is written alone.
        let fits = self.buffer.len() + self.record_bytes() <= BUFFER_BYTES;
        !self.is_full() && (fits || self.buffer.is_empty())
    }

    /// Whether the log is full. Only a checkpoint empties it.
    #[must_use]
    pub fn is_full(&self) -> bool {
        let bytes = self.written + (self.buffer.len() + self.record_bytes()) as u64;
        bytes > self.bytes_max
    }

    /// Buffers a segment for the next `write`.
    ///
    /// # Panics
    /// If the block has the wrong length.
    pub fn append(&mut self, header: &SegmentHeader, block: &[f32]) {
        assert_eq!(block.len(), self.layout.block_len(), "segment block length");
        let (header, block) = (bytemuck::bytes_of(header), bytemuck::cast_slice(block));
        let mut checksum = crc32fast::Hasher::new();
        checksum.update(header);
        checksum.update(block);
        let bytes = (header.len() + block.len()) as u32;
        self.buffer.extend_from_slice(&bytes.to_le_bytes());
        self.buffer.extend_from_slice(&checksum.finalize().to_le_bytes());
        self.buffer.extend_from_slice(header);
        self.buffer.extend_from_slice(block);
    }

    /// Writes the buffered records. After an error they stay in the buffer, and the next call
    /// retries all of them.
    ///
    /// # Errors
    /// `Io` if the file system returns an error.
    pub fn write(&mut self) -> Result<(), LogError> {
        if self.torn {
            self.cut()?;
        }
        if self.buffer.is_empty() {
            return Ok(());
        }
        self.torn = true;
        self.file.write_all(&self.buffer)?;
        self.torn = false;
        self.written += self.buffer.len() as u64;
        self.buffer.clear();
        Ok(())
    }

    /// Total bytes of records, written or buffered.
    #[must_use]
    pub fn logged(&self) -> u64 {
        self.written + self.buffer.len() as u64
    }

    /// Removes the first `bytes` of records, which a checkpoint on disk contains.
    ///
    /// # Errors
    /// `Io` if the file system returns an error. The log is then unchanged.
    ///
    /// # Panics
    /// If the log has fewer bytes.
    pub fn forget(&mut self, bytes: u64) -> Result<(), LogError> {
        assert!(bytes <= self.logged(), "the log has fewer bytes");
        if bytes == self.logged() {
            self.buffer.clear();
            self.written = 0;
            self.torn = true;
            return self.cut();
        }
        self.write()?;
        // Rewrites the file. The rest is small: it was added while the checkpoint was written.
        let mut rest = Vec::new();
        // If the rewrite fails, the next write must seek to the end of the records first.
        self.torn = true;
        self.file.seek(SeekFrom::Start(HEAD_BYTES as u64 + bytes))?;
        self.file.read_to_end(&mut rest)?;
        let temporary = self.path.with_extension("tmp");
        let mut options = OpenOptions::new();
        let options = options.read(true).write(true).create(true).truncate(true).mode(0o600);
        let mut file = options.open(&temporary)?;
        file.write_all(&self.head)?;
        file.write_all(&rest)?;
        std::fs::rename(&temporary, &self.path)?;
        self.file = file;
        self.written = rest.len() as u64;
        self.torn = false;
        Ok(())
    }

    /// Truncates the file after the last complete record and seeks to its end.
    fn cut(&mut self) -> Result<(), LogError> {
        let len = HEAD_BYTES as u64 + self.written;
        self.file.set_len(len)?;
        self.file.seek(SeekFrom::Start(len))?;
        self.torn = false;
        Ok(())
    }

    fn record_bytes(&self) -> usize {
        let block = self.layout.block_len() * size_of::<f32>();
        FRAME_BYTES + size_of::<SegmentHeader>() + block
    }
}

/// Decodes one record. Returns false if its length or checksum is wrong.
fn decode(record: &[u8], segment: &mut Segment) -> bool {
    let (frame, payload) = record.split_at(FRAME_BYTES);
    let expected = [payload.len() as u32, crc32fast::hash(payload)].map(u32::to_le_bytes);
    if frame != expected.as_flattened() {
        return false;
    }
    let (header, block) = payload.split_at(size_of::<SegmentHeader>());
    segment.header = bytemuck::pod_read_unaligned(header);
    bytemuck::cast_slice_mut(&mut segment.block).copy_from_slice(block);
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 2, observation_len: 3, action_len: 1 };
    const BYTES_MAX: u64 = 1_000;

    fn segment(sequence: u64) -> Segment {
        let mut segment = Segment::zeroed(LAYOUT);
        segment.header.sequence = sequence;
        segment.block.fill(sequence as f32);
        segment
    }

    fn open(path: &Path) -> SegmentLog {
        let identity = LogIdentity { run_id: 1, architecture_hash: 2 };
        SegmentLog::open(path, identity, LAYOUT, BYTES_MAX).unwrap()
    }

    fn append(log: &mut SegmentLog, sequences: std::ops::RangeInclusive<u64>) {
        for sequence in sequences {
            let Segment { header, block } = segment(sequence);
            log.append(&header, &block);
        }
    }

    fn replay(path: &Path) -> (Vec<u64>, Replayed) {
        let mut sequences = Vec::new();
        let replayed = open(path).replay(|found| {
            assert_eq!(*found, segment(found.header.sequence));
            sequences.push(found.header.sequence);
        });
        (sequences, replayed.unwrap())
    }

    #[test]
    fn written_records_are_replayed_and_buffered_ones_are_lost() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let mut log = open(&path);
        append(&mut log, 1..=3);
        log.write().unwrap();
        append(&mut log, 4..=4);
        drop(log);
        assert_eq!(replay(&path), (vec![1, 2, 3], Replayed { records: 3, cut_bytes: 0 }));
        let mut log = open(&path);
        log.replay(|_| {}).unwrap();
        append(&mut log, 4..=4);
        log.write().unwrap();
        assert_eq!(replay(&path).0, [1, 2, 3, 4]);
        log.forget(log.logged()).unwrap();
        append(&mut log, 5..=5);
        log.write().unwrap();
        assert_eq!(replay(&path).0, [5]);
    }

    #[test]
    fn records_added_after_a_checkpoint_are_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let mut log = open(&path);
        append(&mut log, 1..=2);
        log.write().unwrap();
        append(&mut log, 3..=3);
        let in_checkpoint = log.logged();
        append(&mut log, 4..=5);
        log.forget(in_checkpoint).unwrap();
        append(&mut log, 6..=6);
        log.write().unwrap();
        assert_eq!(replay(&path), (vec![4, 5, 6], Replayed { records: 3, cut_bytes: 0 }));
        let others = std::fs::read_dir(folder.path()).unwrap().count();
        assert_eq!(others, 1, "no temporary file is left");
    }

    #[test]
    fn log_is_truncated_at_an_incomplete_or_corrupted_record() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let mut log = open(&path);
        append(&mut log, 1..=3);
        log.write().unwrap();
        let valid = std::fs::read(&path).unwrap();
        let record = log.record_bytes();
        drop(log);
        for len in 0..valid.len() {
            std::fs::write(&path, &valid[..len]).unwrap();
            let whole = len.saturating_sub(HEAD_BYTES) / record;
            let (sequences, replayed) = replay(&path);
            assert_eq!(sequences.len(), whole, "{len} bytes");
            let cut = len.saturating_sub(HEAD_BYTES) - whole * record;
            assert_eq!(replayed, Replayed { records: whole as u64, cut_bytes: cut as u64 });
        }
        for at in HEAD_BYTES..valid.len() {
            let mut corrupted = valid.clone();
            corrupted[at] ^= 0x10;
            std::fs::write(&path, &corrupted).unwrap();
            assert_eq!(replay(&path).0.len(), (at - HEAD_BYTES) / record, "byte {at}");
            assert_eq!(replay(&path).1.cut_bytes, 0, "the file has been truncated");
        }
    }

    #[test]
    fn log_of_another_run_is_rejected() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        drop(open(&path));
        for (run_id, architecture_hash) in [(2, 2), (1, 3)] {
            let identity = LogIdentity { run_id, architecture_hash };
            let error = SegmentLog::open(&path, identity, LAYOUT, BYTES_MAX).unwrap_err();
            assert!(matches!(error, LogError::Foreign), "{error}");
        }
    }

    #[test]
    fn full_log_has_no_room_until_it_is_cleared() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = open(&folder.path().join("log"));
        let count = BYTES_MAX / log.record_bytes() as u64;
        for sequence in 1..=count {
            assert!(log.has_room());
            append(&mut log, sequence..=sequence);
            log.write().unwrap();
        }
        assert!(log.is_full() && !log.has_room());
        log.forget(log.logged()).unwrap();
        assert!(log.has_room());
    }
}
