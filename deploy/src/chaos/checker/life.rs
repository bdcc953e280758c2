//! One start of a worker: what it produced, and what of it a learner's lineage has.

use std::collections::BTreeSet;
use std::ops::RangeInclusive;

/// By sequence number, from 1.
#[derive(Debug, Clone, Default)]
pub(super) struct Life {
    /// Checksum of each segment when it was produced.
    pub(super) produced: Vec<u32>,
    /// Up to here the worker has forgotten them.
    pub(super) acked: u64,
    /// Refused for good.
    pub(super) refused: BTreeSet<u64>,
    /// Epoch and version of the policy taken last.
    pub(super) policy: (u64, u64),
    /// The last that was settled: inserted or refused.
    through: u64,
    /// Left out below it, in order: what came later says that they never will.
    gaps: Vec<RangeInclusive<u64>>,
}

impl Life {
    /// Whether the lineage has settled this one.
    pub(super) fn holds(&self, sequence: u64) -> bool {
        sequence <= self.through && !self.gaps.iter().any(|gap| gap.contains(&sequence))
    }

    /// Settles one beyond all before.
    pub(super) fn settle(&mut self, sequence: u64) {
        if sequence > self.through + 1 {
            self.gaps.push(self.through + 1..=sequence - 1);
        }
        self.through = sequence;
    }

    /// The lineage goes back to this one.
    pub(super) fn forget_after(&mut self, sequence: u64) {
        self.through = self.through.min(sequence);
        self.refused.retain(|refused| *refused <= sequence);
        self.gaps.retain(|gap| *gap.start() <= sequence);
        if let Some(last) = self.gaps.last_mut() {
            *last = *last.start()..=(*last.end()).min(sequence);
        }
    }

    /// Segments inserted.
    pub(super) fn inserted(&self) -> u64 {
        self.through - self.missing() - self.refused.len() as u64
    }

    /// Segments that are gone: left out, or acknowledged and not there.
    pub(super) fn lost(&self) -> u64 {
        self.missing() + self.acked.saturating_sub(self.through)
    }

    /// Segments that never arrived and that nobody was promised.
    pub(super) fn in_flight(&self) -> u64 {
        (self.produced.len() as u64).saturating_sub(self.through.max(self.acked))
    }

    fn missing(&self) -> u64 {
        self.gaps.iter().map(|gap| gap.end() + 1 - gap.start()).sum()
    }
}
