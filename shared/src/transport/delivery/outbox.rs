//! The worker's side of reliable delivery: a bounded ring of unacknowledged segments.

use serde::{Deserialize, Serialize};

use super::{Acknowledgements, Watermark};
use crate::segment::{SegmentHeader, SegmentLayout};
use crate::transport::{SegmentSender, SendOutcome, TransportError};

/// Counts of a worker's segments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sent {
    /// Segments put into the outbox.
    pub produced: u64,
    /// Segments accepted by a queue, including retransmits.
    pub sent: u64,
    /// Retransmits, which `sent` includes.
    pub resent: u64,
    /// Acknowledged segments.
    pub acked: u64,
}

impl Sent {
    /// Returns the difference to an earlier count.
    #[must_use]
    pub fn since(&self, before: &Self) -> Self {
        Self {
            produced: self.produced - before.produced,
            sent: self.sent - before.sent,
            resent: self.resent - before.resent,
            acked: self.acked - before.acked,
        }
    }
}

impl std::ops::AddAssign for Sent {
    fn add_assign(&mut self, more: Self) {
        self.produced += more.produced;
        self.sent += more.sent;
        self.resent += more.resent;
        self.acked += more.acked;
    }
}

/// Unacknowledged segments of one incarnation of a worker. The worker waits while the outbox is
/// full.
#[derive(Debug)]
pub struct Outbox {
    worker_id: u32,
    incarnation: u32,
    block_len: usize,
    headers: Vec<SegmentHeader>,
    /// (ring, block). Zeroed pages take no memory until a segment is written to them.
    blocks: Vec<f32>,
    /// Sequence number of the oldest segment kept. first <= next <= end.
    first: u64,
    /// Sequence number of the next segment to offer.
    next: u64,
    /// Sequence number of the next segment to put in.
    end: u64,
    /// Highest sequence number that any queue has accepted.
    highest_sent: u64,
    /// Number of the newest learner that has sent an acknowledgement.
    epoch: u64,
    sent: Sent,
}

impl Outbox {
    /// Creates an empty outbox for `segments_max` segments.
    ///
    /// # Panics
    /// If `segments_max` is 0.
    #[must_use]
    pub fn new(
        layout: SegmentLayout,
        segments_max: usize,
        worker_id: u32,
        incarnation: u32,
    ) -> Self {
        Self::starting_at(1, layout, segments_max, worker_id, incarnation)
    }

    /// Creates an empty outbox that continues a sequence: all segments before `first` are
    /// acknowledged.
    ///
    /// # Panics
    /// If `segments_max` or `first` is 0. Sequences start at 1.
    #[must_use]
    pub fn starting_at(
        first: u64,
        layout: SegmentLayout,
        segments_max: usize,
        worker_id: u32,
        incarnation: u32,
    ) -> Self {
        assert!(segments_max > 0, "an outbox needs room for at least one segment");
        assert!(first > 0, "the first segment has sequence 1");
        let block_len = layout.block_len();
        Self {
            worker_id,
            incarnation,
            block_len,
            headers: vec![SegmentHeader::default(); segments_max],
            blocks: vec![0.0; segments_max * block_len],
            first,
            next: first,
            end: first,
            highest_sent: first - 1,
            epoch: 0,
            sent: Sent::default(),
        }
    }

    /// Worker that owns the outbox.
    #[must_use]
    pub fn worker_id(&self) -> u32 {
        self.worker_id
    }

    /// Incarnation of the worker that owns the outbox.
    #[must_use]
    pub fn incarnation(&self) -> u32 {
        self.incarnation
    }

    /// Counts of the worker's segments so far.
    #[must_use]
    pub fn sent(&self) -> Sent {
        self.sent
    }

    /// Number of unacknowledged segments.
    #[must_use]
    pub fn len(&self) -> usize {
        (self.end - self.first) as usize
    }

    /// Sequence number of the oldest segment kept; all earlier ones are acknowledged.
    #[must_use]
    pub fn first(&self) -> u64 {
        self.first
    }

    /// Sequence number of the next segment to put in.
    #[must_use]
    pub fn end(&self) -> u64 {
        self.end
    }

    /// Number of unacknowledged segments that a queue has accepted.
    #[must_use]
    pub fn in_flight(&self) -> usize {
        (self.next - self.first) as usize
    }

    /// Number of segments that no queue has accepted yet.
    #[must_use]
    pub fn unsent(&self) -> usize {
        (self.end - self.next) as usize
    }

    /// Whether all segments are acknowledged.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.first == self.end
    }

    /// Maximum number of segments kept.
    #[must_use]
    pub fn capacity(&self) -> usize {
        self.headers.len()
    }

    /// Keeps a copy of the worker's next segment. Returns false if the outbox is full.
    ///
    /// # Panics
    /// If the segment is from another worker or incarnation, is not the next in sequence, or has
    /// the wrong length.
    pub fn put(&mut self, header: &SegmentHeader, block: &[f32]) -> bool {
        let origin = (header.worker_id, header.incarnation, header.sequence);
        assert_eq!(origin, (self.worker_id, self.incarnation, self.end), "not the next segment");
        if self.len() == self.capacity() {
            return false;
        }
        let slot = self.slot(self.end);
        self.headers[slot] = *header;
        self.blocks[slot * self.block_len..(slot + 1) * self.block_len].copy_from_slice(block);
        self.end += 1;
        self.sent.produced += 1;
        true
    }

    /// Offers unsent segments, oldest first. After a reconnection it offers all kept segments.
    ///
    /// Returns `Delivered` if no unsent segment is left, otherwise the outcome of the last offer.
    /// Call it as long as the outbox is not empty, even without new segments: after a restart, the
    /// learner may lack segments that were already sent.
    ///
    /// # Errors
    /// The errors of the link.
    pub fn offer(&mut self, link: &mut impl SegmentSender) -> Result<SendOutcome, TransportError> {
        if link.renew()? {
            self.next = self.first;
        }
        while self.next < self.end {
            let slot = self.slot(self.next);
            let block = &self.blocks[slot * self.block_len..(slot + 1) * self.block_len];
            let outcome = link.try_send(&self.headers[slot], block)?;
            if outcome != SendOutcome::Delivered {
                return Ok(outcome);
            }
            self.sent.sent += 1;
            self.sent.resent += u64::from(self.next <= self.highest_sent);
            self.highest_sent = self.highest_sent.max(self.next);
            self.next += 1;
        }
        Ok(SendOutcome::Delivered)
    }

    /// Discards acknowledged segments. Acknowledgements of a replaced learner are ignored, because
    /// its successor may have restored fewer segments.
    pub fn acknowledge(&mut self, acknowledgements: &Acknowledgements) {
        let Some(mark) = acknowledgements.marks.get(self.worker_id as usize) else { return };
        if acknowledgements.epoch < self.epoch {
            return;
        }
        self.epoch = acknowledgements.epoch;
        self.acknowledge_to(*mark);
    }

    /// Discards segments up to `mark`, which must belong to this worker and be the newest.
    pub fn acknowledge_to(&mut self, mark: Watermark) {
        let ours = mark.incarnation == self.incarnation && mark.sequence < self.end;
        if ours && mark.sequence >= self.first {
            self.sent.acked += mark.sequence + 1 - self.first;
            self.first = mark.sequence + 1;
            self.next = self.next.max(self.first);
        }
    }

    /// Discards all segments and continues at `first`, because the learner already has all segments
    /// before it.
    ///
    /// # Panics
    /// If `first` is before the end of the sequence.
    pub fn skip_to(&mut self, first: u64) {
        assert!(first >= self.end, "sequence numbers of an outbox never decrease");
        (self.first, self.next, self.end) = (first, first, first);
        self.highest_sent = first - 1;
    }

    fn slot(&self, sequence: u64) -> usize {
        (sequence % self.headers.len() as u64) as usize
    }
}
