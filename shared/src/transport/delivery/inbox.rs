//! The learner's side of the delivery: which segments of each worker have been settled.

use super::{LogError, SegmentLog, Watermark};
use crate::segment::{Rejection, SegmentHeader};

/// Settled segments after which an acknowledgement is due, because an acknowledgement costs far
/// less than settling this many. It is a quarter of the default outbox capacity beyond its queue,
/// so no worker runs out of space before the acknowledgement arrives.
const ACKNOWLEDGED_TOGETHER: u64 = 256;

/// Settled segments of each worker, and the log of those that no checkpoint contains yet.
#[derive(Debug)]
pub struct Inbox {
    settled: Vec<Watermark>,
    /// Segments settled since the last acknowledgement.
    unacknowledged: u64,
    /// At level `log`, every settled segment is appended.
    log: Option<SegmentLog>,
}

impl Inbox {
    /// Creates an inbox without settled segments and without a log.
    #[must_use]
    pub fn new(worker_count: usize) -> Self {
        Self { settled: vec![Watermark::default(); worker_count], unacknowledged: 0, log: None }
    }

    /// Continues from a checkpoint's marks. Workers without a mark start from zero.
    pub fn restore(&mut self, marks: &[Watermark]) {
        for (index, settled) in self.settled.iter_mut().enumerate() {
            *settled = marks.get(index).copied().unwrap_or_default();
        }
    }

    /// Appends settled segments to `log` from now on. Its existing records must be settled already.
    pub fn log_to(&mut self, log: SegmentLog) {
        self.log = Some(log);
    }

    /// Last settled segment of each worker, as stored in a checkpoint. Settled means inserted or
    /// finally rejected.
    #[must_use]
    pub fn settled(&self) -> &[Watermark] {
        &self.settled
    }

    /// Whether a segment has been settled, or belongs to an incarnation before the newest.
    #[must_use]
    pub fn has(&self, header: &SegmentHeader) -> bool {
        let mark = Watermark { incarnation: header.incarnation, sequence: header.sequence };
        self.settled.get(header.worker_id as usize).is_some_and(|last| mark <= *last)
    }

    /// Settles a segment. Call it at the moment of insertion.
    ///
    /// Returns the number of missing segments before it, which will never arrive. A worker numbers
    /// its segments from 1 without gaps and sends them in order, so it no longer has the missing
    /// ones. Such a gap only occurs at level `memory`, if a learner died after acknowledging the
    /// segments.
    ///
    /// # Errors
    /// `Duplicate` if it has been settled, or belongs to an incarnation before the newest.
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
    /// If writing fails. Nothing new may be acknowledged then, and the workers wait.
    pub fn acknowledge(&mut self) -> Result<&[Watermark], LogError> {
        // Reset first, so that a failed write is retried at the regular interval and not on every
        // turn.
        self.unacknowledged = 0;
        if let Some(log) = &mut self.log {
            log.write()?;
        }
        Ok(&self.settled)
    }

    /// Size of the log at this moment \[bytes\]; a checkpoint taken now contains all of it.
    #[must_use]
    pub fn logged(&self) -> u64 {
        self.log.as_ref().map_or(0, SegmentLog::logged)
    }

    /// Whether enough segments are settled to acknowledge now instead of at the regular interval.
    #[must_use]
    pub fn owes_acknowledgement(&self) -> bool {
        self.unacknowledged >= ACKNOWLEDGED_TOGETHER
    }

    /// Removes the first `logged` bytes of the log after the checkpoint that contains them is on
    /// disk.
    ///
    /// # Errors
    /// If the log cannot be truncated; this only wastes its space.
    pub fn checkpointed(&mut self, logged: u64) -> Result<(), LogError> {
        self.log.as_mut().map_or(Ok(()), |log| log.forget(logged))
    }

    /// Whether another segment can be settled now.
    #[must_use]
    pub fn has_room(&self) -> bool {
        self.log.as_ref().is_none_or(SegmentLog::has_room)
    }

    /// Whether a checkpoint must empty the log before anything can be settled.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.log.as_ref().is_some_and(SegmentLog::is_full)
    }
}
