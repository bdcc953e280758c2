//! The segments of one incarnation of a worker: those it produced, and those in the learner's
//! lineage.

use std::collections::BTreeSet;
use std::ops::RangeInclusive;

/// State of an incarnation's segments. Sequence numbers start at 1.
#[derive(Debug, Clone, Default)]
pub(super) struct IncarnationState {
    /// Checksum of each segment when it was produced.
    pub(super) produced: Vec<u32>,
    /// Highest acknowledged sequence number. The worker has dropped the segments up to it.
    pub(super) acked: u64,
    /// Sequence numbers of permanently rejected segments.
    pub(super) rejected: BTreeSet<u64>,
    /// Epoch and version of the worker's newest policy.
    pub(super) policy: (u64, u64),
    /// Highest settled sequence number. A segment is settled when it is inserted or rejected.
    settled_to: u64,
    /// Gaps below `settled_to`, in order. They are permanent, because later segments were settled.
    gaps: Vec<RangeInclusive<u64>>,
}

impl IncarnationState {
    /// Returns true if the lineage has settled this segment.
    pub(super) fn has_settled(&self, sequence: u64) -> bool {
        sequence <= self.settled_to && !self.gaps.iter().any(|gap| gap.contains(&sequence))
    }

    /// Settles a segment. Its sequence number must be higher than all previous ones.
    pub(super) fn settle(&mut self, sequence: u64) {
        if sequence > self.settled_to + 1 {
            self.gaps.push(self.settled_to + 1..=sequence - 1);
        }
        self.settled_to = sequence;
    }

    /// Rolls the lineage back to this sequence number.
    pub(super) fn roll_back_to(&mut self, sequence: u64) {
        self.settled_to = self.settled_to.min(sequence);
        self.rejected.retain(|rejected| *rejected <= sequence);
        self.gaps.retain(|gap| *gap.start() <= sequence);
        if let Some(last) = self.gaps.last_mut() {
            *last = *last.start()..=(*last.end()).min(sequence);
        }
    }

    /// Returns the number of inserted segments.
    pub(super) fn inserted(&self) -> u64 {
        self.settled_to - self.gaps_len() - self.rejected.len() as u64
    }

    /// Returns the number of lost segments: in a gap, or acknowledged but not settled.
    pub(super) fn lost(&self) -> u64 {
        self.gaps_len() + self.acked.saturating_sub(self.settled_to)
    }

    /// Returns the number of segments that neither arrived nor were acknowledged.
    pub(super) fn in_flight(&self) -> u64 {
        (self.produced.len() as u64).saturating_sub(self.settled_to.max(self.acked))
    }

    fn gaps_len(&self) -> u64 {
        self.gaps.iter().map(|gap| gap.end() + 1 - gap.start()).sum()
    }
}
