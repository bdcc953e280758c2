//! One incarnation of a worker: the segments it produced, and those in the learner's lineage.

use std::collections::BTreeSet;
use std::ops::RangeInclusive;

/// State of an incarnation's segments, by sequence number from 1.
#[derive(Debug, Clone, Default)]
pub(super) struct Life {
    /// Checksum of each segment when it was produced.
    pub(super) produced: Vec<u32>,
    /// Highest acknowledged sequence number: the worker has dropped the segments up to here.
    pub(super) acked: u64,
    /// Segments that were rejected permanently.
    pub(super) refused: BTreeSet<u64>,
    /// Epoch and version of the policy that the worker took last.
    pub(super) policy: (u64, u64),
    /// Highest settled sequence number. A segment is settled when it is inserted or rejected.
    through: u64,
    /// Gaps below `through`, in order. Later segments were settled, so these never will be.
    gaps: Vec<RangeInclusive<u64>>,
}

impl Life {
    /// Returns true if the lineage has settled this segment.
    pub(super) fn holds(&self, sequence: u64) -> bool {
        sequence <= self.through && !self.gaps.iter().any(|gap| gap.contains(&sequence))
    }

    /// Settles a segment beyond all previous ones.
    pub(super) fn settle(&mut self, sequence: u64) {
        if sequence > self.through + 1 {
            self.gaps.push(self.through + 1..=sequence - 1);
        }
        self.through = sequence;
    }

    /// Rolls the lineage back to this segment.
    pub(super) fn forget_after(&mut self, sequence: u64) {
        self.through = self.through.min(sequence);
        self.refused.retain(|refused| *refused <= sequence);
        self.gaps.retain(|gap| *gap.start() <= sequence);
        if let Some(last) = self.gaps.last_mut() {
            *last = *last.start()..=(*last.end()).min(sequence);
        }
    }

    /// Number of inserted segments.
    pub(super) fn inserted(&self) -> u64 {
        self.through - self.missing() - self.refused.len() as u64
    }

    /// Number of lost segments: in a gap, or acknowledged but not settled.
    pub(super) fn lost(&self) -> u64 {
        self.missing() + self.acked.saturating_sub(self.through)
    }

    /// Number of segments that never arrived and were never acknowledged.
    pub(super) fn in_flight(&self) -> u64 {
        (self.produced.len() as u64).saturating_sub(self.through.max(self.acked))
    }

    fn missing(&self) -> u64 {
        self.gaps.iter().map(|gap| gap.end() + 1 - gap.start()).sum()
    }
}
