//! The learner's side of reliable delivery: tracks which segments of each worker are settled.

use super::{LogError, SegmentLog, Watermark};
use crate::segment::{Rejection, SegmentHeader};

/// Number of settled segments after which an acknowledgement is due. Settling this many costs far
/// more than an acknowledgement. It is a quarter of an outbox's default capacity beyond its queue,
/// so no outbox fills up before the acknowledgement arrives.
const ACKNOWLEDGEMENT_BATCH: u64 = 256;

/// The last settled segment of each worker, and the log of segments that no checkpoint contains
/// yet.
#[derive(Debug)]
pub struct Inbox {
    settled: Vec<Watermark>,
    /// Segments settled since the last acknowledgement.
    unacknowledged: u64,
    /// Contains every settled segment at delivery level `log`; `None` at level `memory`.
    log: Option<SegmentLog>,
}

impl Inbox {
    /// Creates an inbox without settled segments and without a log.
    #[must_use]
    pub fn new(worker_count: usize) -> Self {
        Self { settled: vec![Watermark::default(); worker_count], unacknowledged: 0, log: None }
    }

    /// Restores the marks of a checkpoint. Workers without a mark start from zero.
    pub fn restore(&mut self, marks: &[Watermark]) {
        for (index, settled) in self.settled.iter_mut().enumerate() {
            *settled = marks.get(index).copied().unwrap_or_default();
        }
    }

    /// Appends settled segments to `log` from now on. The records in it must be settled already.
    pub fn log_to(&mut self, log: SegmentLog) {
        self.log = Some(log);
    }

    /// Last settled segment of each worker, as stored in checkpoints. A segment is settled when it
    /// has been inserted or finally rejected.
    #[must_use]
    pub fn settled(&self) -> &[Watermark] {
        &self.settled
    }

    /// Whether a segment has been settled or belongs to an old incarnation.
    #[must_use]
    pub fn has(&self, header: &SegmentHeader) -> bool {
        let mark = Watermark { incarnation: header.incarnation, sequence: header.sequence };
        self.settled.get(header.worker_id as usize).is_some_and(|last| mark <= *last)
    }

    /// Settles a segment. Call it together with the insertion.
    ///
    /// Returns the number of segments missing before it. A worker numbers its segments from 1
    /// without gaps and sends them in order, so the missing ones are lost. This happens only at
    /// level `memory`, if a learner died after acknowledging them.
    ///
    /// # Errors
    /// `Duplicate` if the segment has been settled or belongs to an old incarnation.
    ///
    /// # Panics
    /// If the worker does not exist or the block has the wrong length. Call `segment::check` first.
    pub fn settle(&mut self, header: &SegmentHeader, block: &[f32]) -> Result<u64, Rejection> {
        if self.has(header) {
            return Err(Rejection::Duplicate);
        }
        let last = &mut self.settled[header.worker_id as usize];
        let mark = Watermark { incarnation: header.incarnation, sequence: header.sequence };
        let before = if mark.incarnation == last.incarnation { last.sequence } else { 0 };
        *last = mark;
        self.unacknowledged += 1;
        if let Some(log) = &mut self.log {
            log.append(header, block);
        }
        Ok(mark.sequence - before - 1)
    }

    /// Returns the marks up to which workers may discard their segments. At level `log`, the
    /// segments are written to the log first.
    ///
    /// # Errors
    /// If writing fails. The caller must then not acknowledge anything new; workers wait.
    pub fn acknowledge(&mut self) -> Result<&[Watermark], LogError> {
        // Reset before the write, so that a failed write is retried only at the regular interval.
        self.unacknowledged = 0;
        if let Some(log) = &mut self.log {
            log.write()?;
        }
        Ok(&self.settled)
    }

    /// Current size of the log \[bytes\]. A checkpoint taken now contains all of it.
    #[must_use]
    pub fn logged(&self) -> u64 {
        self.log.as_ref().map_or(0, SegmentLog::logged)
    }

    /// Whether enough segments are settled to send an acknowledgement before the regular interval
    /// ends.
    #[must_use]
    pub fn owes_acknowledgement(&self) -> bool {
        self.unacknowledged >= ACKNOWLEDGEMENT_BATCH
    }

    /// Removes the first `logged` bytes of the log. Call it when the checkpoint that contains them
    /// is on disk.
    ///
    /// # Errors
    /// If the log cannot be truncated. This only wastes space.
    pub fn checkpointed(&mut self, logged: u64) -> Result<(), LogError> {
        self.log.as_mut().map_or(Ok(()), |log| log.forget(logged))
    }

    /// Whether another segment can be settled now.
    #[must_use]
    pub fn has_room(&self) -> bool {
        self.log.as_ref().is_none_or(SegmentLog::has_room)
    }

    /// Whether the log is full, so that only a checkpoint makes room for more segments.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.log.as_ref().is_some_and(SegmentLog::is_full)
    }
}
