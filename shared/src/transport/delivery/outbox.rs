//! The worker's side: a bounded ring of segments that the learner has not acknowledged.

use serde::{Deserialize, Serialize};

use super::{Acknowledgements, Mark};
use crate::segment::{SegmentHeader, SegmentLayout};
use crate::transport::{SegmentSender, SendOutcome, TransportError};

/// What a worker did; each a count of segments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sent {
    /// Finished and put into the outbox.
    pub produced: u64,
    /// Taken by a queue, those that were sent again included.
    pub sent: u64,
    /// Of these, sent again.
    pub resent: u64,
    /// Acknowledged.
    pub acked: u64,
}

impl Sent {
    /// What has been added since `before`.
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

/// Everything of one incarnation of a worker that is not acknowledged yet. Full: the worker waits.
#[derive(Debug)]
pub struct Outbox {
    worker_id: u32,
    incarnation: u32,
    block_len: usize,
    headers: Vec<SegmentHeader>,
    /// (ring, block). Zeroed pages cost nothing until a segment is written to them.
    blocks: Vec<f32>,
    /// Sequence numbers: the oldest that is kept, the next to be offered, the next to be put in,
    /// and the highest that any queue has taken. first <= next <= end.
    first: u64,
    next: u64,
    end: u64,
    highest_sent: u64,
    /// The newest learner that has acknowledged anything.
    epoch: u64,
    sent: Sent,
}

impl Outbox {
    /// An empty one for `segments_max` segments.
    ///
    /// # Panics
    /// If it has room for none.
    #[must_use]
    pub fn new(
        layout: SegmentLayout,
        segments_max: usize,
        worker_id: u32,
        incarnation: u32,
    ) -> Self {
        Self::starting_at(1, (layout, segments_max), worker_id, incarnation)
    }

    /// The same for whoever takes over in the middle: the segments before `first` are acknowledged.
    ///
    /// # Panics
    /// If it has room for none, or `first` is 0: sequences begin at 1.
    #[must_use]
    pub fn starting_at(
        first: u64,
        (layout, segments_max): (SegmentLayout, usize),
        worker_id: u32,
        incarnation: u32,
    ) -> Self {
        assert!(segments_max > 0, "an outbox holds at least one segment");
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

    /// Whose it is.
    #[must_use]
    pub fn worker_id(&self) -> u32 {
        self.worker_id
    }

    /// Which start of the worker.
    #[must_use]
    pub fn incarnation(&self) -> u32 {
        self.incarnation
    }

    /// What the worker has done so far.
    #[must_use]
    pub fn sent(&self) -> Sent {
        self.sent
    }

    /// Segments that are not acknowledged.
    #[must_use]
    pub fn len(&self) -> usize {
        (self.end - self.first) as usize
    }

    /// Sequence number of the oldest segment that is kept; all before it are acknowledged.
    #[must_use]
    pub fn first(&self) -> u64 {
        self.first
    }

    /// Sequence number of the segment that is to be put in next.
    #[must_use]
    pub fn end(&self) -> u64 {
        self.end
    }

    /// Segments that were offered and taken, and are not acknowledged.
    #[must_use]
    pub fn under_way(&self) -> usize {
        (self.next - self.first) as usize
    }

    /// Segments that were put in and are still to be offered.
    #[must_use]
    pub fn unsent(&self) -> usize {
        (self.end - self.next) as usize
    }

    /// Whether all are acknowledged.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.first == self.end
    }

    /// Segments there is room for.
    #[must_use]
    pub fn capacity(&self) -> usize {
        self.headers.len()
    }

    /// Keeps a copy of the worker's next segment; false if there is no room.
    ///
    /// # Panics
    /// If it is another worker's, not the next in sequence, or of another length.
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

    /// Offers what no queue has taken yet, oldest first, and after a new connection everything
    /// that is kept. `Delivered`: nothing is left to offer; otherwise why not. To be called while
    /// anything is kept, not only when there is something new: the next learner may lack it.
    ///
    /// # Errors
    /// Those of the link.
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

    /// Forgets what has arrived. What a learner said that is gone by now is not taken: its
    /// successor may have less, and is still to be sent the rest.
    pub fn acknowledge(&mut self, acknowledgements: &Acknowledgements) {
        let Some(mark) = acknowledgements.marks.get(self.worker_id as usize) else { return };
        if acknowledgements.epoch < self.epoch {
            return;
        }
        self.epoch = acknowledgements.epoch;
        self.acknowledge_to(*mark);
    }

    /// Forgets what has arrived, where the caller knows that the mark is of its worker, and the
    /// newest.
    pub fn acknowledge_to(&mut self, mark: Mark) {
        let ours = mark.incarnation == self.incarnation && mark.sequence < self.end;
        if ours && mark.sequence >= self.first {
            self.sent.acked += mark.sequence + 1 - self.first;
            self.first = mark.sequence + 1;
            self.next = self.next.max(self.first);
        }
    }

    fn slot(&self, sequence: u64) -> usize {
        (sequence % self.headers.len() as u64) as usize
    }
}
