//! The learner's side: what has come of each worker, and how far it is safe.

use super::Mark;
use crate::config::DeliveryLevel;
use crate::segment::{Rejection, SegmentHeader};

/// How far each worker's segments have come.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Inbox {
    level: DeliveryLevel,
    settled: Vec<Mark>,
    /// Up to where all is in the log or in a checkpoint.
    stored: Vec<Mark>,
}

impl Inbox {
    /// Nothing has come of any worker.
    #[must_use]
    pub fn new(level: DeliveryLevel, worker_count: usize) -> Self {
        let marks = vec![Mark::default(); worker_count];
        Self { level, settled: marks.clone(), stored: marks }
    }

    /// Goes on from a checkpoint's marks. One without has seen no worker that lives.
    pub fn restore(&mut self, marks: &[Mark]) {
        for (index, settled) in self.settled.iter_mut().enumerate() {
            *settled = marks.get(index).copied().unwrap_or_default();
        }
        self.stored.copy_from_slice(&self.settled);
    }

    /// Up to where segments have been settled: inserted, or refused for good. What a checkpoint
    /// holds.
    #[must_use]
    pub fn settled(&self) -> &[Mark] {
        &self.settled
    }

    /// Up to where workers may forget their segments.
    #[must_use]
    pub fn acknowledged(&self) -> &[Mark] {
        match self.level {
            DeliveryLevel::Memory => &self.settled,
            DeliveryLevel::Log => &self.stored,
        }
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
    /// If there is no such worker: `segment::check` comes first.
    pub fn settle(&mut self, header: &SegmentHeader) -> Result<u64, Rejection> {
        if self.has(header) {
            return Err(Rejection::Duplicate);
        }
        let last = &mut self.settled[header.worker_id as usize];
        let mark = Mark { incarnation: header.incarnation, sequence: header.sequence };
        let before = if mark.incarnation == last.incarnation { last.sequence } else { 0 };
        *last = mark;
        Ok(mark.sequence - before - 1)
    }

    /// Whether a segment was settled before, or is of an incarnation before the newest.
    #[must_use]
    pub fn has(&self, header: &SegmentHeader) -> bool {
        let mark = Mark { incarnation: header.incarnation, sequence: header.sequence };
        self.settled.get(header.worker_id as usize).is_some_and(|last| mark <= *last)
    }

    /// Everything settled so far is in the log or in a checkpoint.
    pub fn stored(&mut self) {
        self.stored.copy_from_slice(&self.settled);
    }
}
