//! The learner's side: what has come of each worker, and how far it is safe.

use super::{LogError, Mark, SegmentLog};
use crate::segment::{Rejection, SegmentHeader};

/// Acknowledging costs far less than settling so many. A quarter of what an outbox has beyond its
/// queue by default, so that no worker runs out of room before it hears of them.
const ACKNOWLEDGED_TOGETHER: u64 = 256;

/// How far each worker's segments have come, and the log of those that no checkpoint holds yet.
#[derive(Debug)]
pub struct Inbox {
    settled: Vec<Mark>,
    /// Settled since the last acknowledgement.
    unacknowledged: u64,
    /// At level `log`: every segment is appended as it is settled.
    log: Option<SegmentLog>,
}

impl Inbox {
    /// Nothing has come of any worker, and nothing is logged.
    #[must_use]
    pub fn new(worker_count: usize) -> Self {
        Self { settled: vec![Mark::default(); worker_count], unacknowledged: 0, log: None }
    }

    /// Goes on from a checkpoint's marks. One without has seen no worker that lives.
    pub fn restore(&mut self, marks: &[Mark]) {
        for (index, settled) in self.settled.iter_mut().enumerate() {
            *settled = marks.get(index).copied().unwrap_or_default();
        }
    }

    /// Logs to `log` from now on, whose records have been settled.
    pub fn log_to(&mut self, log: SegmentLog) {
        self.log = Some(log);
    }

    /// Up to where segments have been settled: inserted, or refused for good. What a checkpoint
    /// holds.
    #[must_use]
    pub fn settled(&self) -> &[Mark] {
        &self.settled
    }

    /// Whether a segment was settled before, or is of an incarnation before the newest.
    #[must_use]
    pub fn has(&self, header: &SegmentHeader) -> bool {
        let mark = Mark { incarnation: header.incarnation, sequence: header.sequence };
        self.settled.get(header.worker_id as usize).is_some_and(|last| mark <= *last)
    }

    /// Settles a segment, to be called in the moment in which it is inserted. Returns how many
    /// before it will never come: a worker numbers its segments from 1 without gaps and sends what
    /// it keeps in order, so those it keeps no more. Only a learner that died after it had
    /// acknowledged them leaves such a gap, at level `memory`.
    ///
    /// # Errors
    /// `Duplicate` if it was settled before, or is of an incarnation before the newest.
    ///
    /// # Panics
    /// If there is no such worker or the block is of another length: `segment::check` comes first.
    pub fn settle(&mut self, header: &SegmentHeader, block: &[f32]) -> Result<u64, Rejection> {
        if self.has(header) {
            return Err(Rejection::Duplicate);
        }
        let last = &mut self.settled[header.worker_id as usize];
        let mark = Mark { incarnation: header.incarnation, sequence: header.sequence };
        let before = if mark.incarnation == last.incarnation { last.sequence } else { 0 };
        *last = mark;
        self.unacknowledged += 1;
        if let Some(log) = &mut self.log {
            log.append(header, block);
        }
        Ok(mark.sequence - before - 1)
    }

    /// Up to where workers may forget their segments; at level `log` these are written first.
    ///
    /// # Errors
    /// If they cannot be written: then nothing new may be acknowledged, and workers wait.
    pub fn acknowledge(&mut self) -> Result<&[Mark], LogError> {
        // First: what cannot be written now is tried again in time, not at every turn.
        self.unacknowledged = 0;
        if let Some(log) = &mut self.log {
            log.write()?;
        }
        Ok(&self.settled)
    }

    /// How much has been logged: what a checkpoint of this moment holds of it \[bytes\].
    #[must_use]
    pub fn logged(&self) -> u64 {
        self.log.as_ref().map_or(0, SegmentLog::logged)
    }

    /// Whether so much was settled that workers should hear of it now, and not in time.
    #[must_use]
    pub fn owes_acknowledgement(&self) -> bool {
        self.unacknowledged >= ACKNOWLEDGED_TOGETHER
    }

    /// A checkpoint is on disk, of the moment in which so much had been logged.
    ///
    /// # Errors
    /// If the log cannot be shortened, which costs nothing but its room.
    pub fn checkpointed(&mut self, logged: u64) -> Result<(), LogError> {
        self.log.as_mut().map_or(Ok(()), |log| log.forget(logged))
    }

    /// Whether another segment may be settled now.
    #[must_use]
    pub fn has_room(&self) -> bool {
        self.log.as_ref().is_none_or(SegmentLog::has_room)
    }

    /// Whether nothing can be settled before a checkpoint has emptied the log.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.log.as_ref().is_some_and(SegmentLog::is_full)
    }
}
