//! Receives a worker's segments from the link, at the gateway.
//!
//! A [`LinkReceiver`] takes segments in order and retains them in its own outbox. It offers them to
//! the worker's queue at the learner until the learner has acknowledged them. If the learner dies,
//! they need not cross the link again.

use dmprl_shared::segment::{Segment, SegmentLayout};
use dmprl_shared::transport::delivery::{Outbox, Watermark};
use dmprl_shared::transport::{SegmentSender, SendOutcome, TransportError};

use super::link_sender::drop_acknowledged;
use super::wire::{LinkAck, SegmentRange};

/// Receives the segments of one worker.
#[derive(Debug)]
pub struct LinkReceiver {
    worker: u32,
    layout: SegmentLayout,
    capacity: usize,
    outbox: Option<Outbox>,
    /// Retained segments of the worker's previous incarnation. They go first, because the learner
    /// drops them once it knows the newer incarnation.
    older: Option<Outbox>,
    /// The last retransmit epoch in which a segment was missing; 0 if none.
    rejected_epoch: u32,
    /// Expected sequence number in the current range; `None` to skip the range.
    expected: Option<u64>,
    mark: Watermark,
    rejected: u64,
}

impl LinkReceiver {
    /// Creates the receiver of a worker from which nothing has been received yet.
    #[must_use]
    pub fn new(worker: u32, layout: SegmentLayout, capacity: usize) -> Self {
        Self {
            worker,
            layout,
            capacity,
            outbox: None,
            older: None,
            rejected_epoch: 0,
            expected: None,
            mark: Watermark::default(),
            rejected: 0,
        }
    }

    /// Segments that did not match their range, or that the learner no longer takes.
    #[must_use]
    pub fn rejected(&self) -> u64 {
        self.rejected
    }

    /// Segments that the learner has not acknowledged.
    #[cfg(test)]
    pub(super) fn retained(&self) -> usize {
        self.older.iter().chain(&self.outbox).map(Outbox::len).sum()
    }

    /// Begins a range. If a segment before it is missing, its retransmit epoch is rejected, and the
    /// host begins the next one.
    pub fn begin(&mut self, range: &SegmentRange) {
        self.expected = None;
        if range.retransmit_epoch == self.rejected_epoch || range.oldest == 0 {
            return;
        }
        let is_new = match &self.outbox {
            None => true,
            // The segments in between were acknowledged before they reached this gateway.
            Some(outbox) if range.incarnation == outbox.incarnation() => {
                range.oldest > outbox.end()
            }
            Some(outbox) => range.incarnation > outbox.incarnation(),
        };
        if is_new && !self.begin_outbox(range) {
            self.rejected_epoch = range.retransmit_epoch;
            return;
        }
        let Some(outbox) = &self.outbox else { return };
        if range.incarnation < outbox.incarnation() {
            return;
        }
        if range.start > outbox.end() {
            self.rejected_epoch = range.retransmit_epoch;
            return;
        }
        self.expected = Some(range.start);
    }

    /// Begins an outbox at the oldest segment that the host retains. Returns false if two older
    /// incarnations wait for the learner: a third is not taken before one of them is acknowledged.
    fn begin_outbox(&mut self, range: &SegmentRange) -> bool {
        let incarnation = range.incarnation;
        let previous = self.outbox.take_if(|outbox| outbox.incarnation() < incarnation);
        if let Some(outbox) = previous.filter(|outbox| !outbox.is_empty()) {
            if self.older.is_some() {
                self.outbox = Some(outbox);
                return false;
            }
            self.older = Some(outbox);
        }
        let Self { worker, layout, capacity, .. } = *self;
        let outbox = Outbox::starting_at(range.oldest, layout, capacity, worker, incarnation);
        self.outbox = Some(outbox);
        true
    }

    /// Takes a segment of the current range.
    pub fn receive(&mut self, range: &SegmentRange, segment: &Segment) {
        let (Some(expected), Some(outbox)) = (self.expected, &mut self.outbox) else { return };
        let header = &segment.header;
        let origin = (header.worker_id, header.incarnation, header.sequence);
        if origin != (self.worker, outbox.incarnation(), expected) {
            self.rejected += 1;
            self.expected = None;
            return;
        }
        self.expected = Some(expected + 1);
        // A segment that is already here arrives again if another one was missing.
        if expected == outbox.end() && !outbox.put(header, &segment.block) {
            self.rejected_epoch = range.retransmit_epoch;
            self.expected = None;
        }
    }

    /// Offers the learner the segments that it has not taken.
    ///
    /// # Errors
    /// As the queue's `try_send`.
    pub fn offer(&mut self, queue: &mut impl SegmentSender) -> Result<SendOutcome, TransportError> {
        match self.older.as_mut().or(self.outbox.as_mut()) {
            Some(outbox) if !outbox.is_empty() => outbox.offer(queue),
            _ => Ok(SendOutcome::Delivered),
        }
    }

    /// Drops the segments that the learner has acknowledged.
    pub fn acknowledge(&mut self, mark: Watermark) {
        self.mark = mark;
        for outbox in self.older.iter_mut().chain(&mut self.outbox) {
            drop_acknowledged(outbox, mark);
        }
        self.older.take_if(|outbox| outbox.is_empty());
        // The learner knows a newer incarnation and will never take these segments. Retaining them
        // would block the newer incarnation.
        if let Some(useless) = self.older.take_if(|older| older.incarnation() < mark.incarnation) {
            self.rejected += useless.len() as u64;
        }
    }

    /// The state of this worker to report to its host.
    #[must_use]
    pub fn ack(&self) -> LinkAck {
        LinkAck {
            sequence: self.mark.sequence,
            received: self.outbox.as_ref().map_or(0, |outbox| outbox.end() - 1),
            incarnation: self.mark.incarnation,
            received_incarnation: self.outbox.as_ref().map_or(0, Outbox::incarnation),
            rejected_epoch: self.rejected_epoch,
            reserved: 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::segment::SegmentHeader;

    use super::*;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 1, observation_len: 1, action_len: 1 };

    /// A queue that accepts every segment.
    #[derive(Default)]
    struct Queue {
        taken: Vec<(u32, u64)>,
    }

    impl SegmentSender for Queue {
        fn renew(&mut self) -> Result<bool, TransportError> {
            Ok(false)
        }

        fn try_send(
            &mut self,
            header: &SegmentHeader,
            _block: &[f32],
        ) -> Result<SendOutcome, TransportError> {
            self.taken.push((header.incarnation, header.sequence));
            Ok(SendOutcome::Delivered)
        }
    }

    fn receive(
        receiver: &mut LinkReceiver,
        incarnation: u32,
        retransmit_epoch: u32,
        sequences: [u64; 2],
    ) {
        let [first, last] = sequences;
        let count = (last + 1 - first) as u32;
        let range = SegmentRange {
            oldest: first,
            start: first,
            worker: 7,
            incarnation,
            retransmit_epoch,
            count,
        };
        receiver.begin(&range);
        for sequence in first..=last {
            let header =
                SegmentHeader { worker_id: 7, incarnation, sequence, ..SegmentHeader::default() };
            receiver.receive(&range, &Segment { header, ..Segment::zeroed(LAYOUT) });
        }
    }

    /// Regression test: after relay and worker have died together, only the gateway has these
    /// segments. They were once dropped.
    #[test]
    fn segments_of_a_dead_incarnation_reach_the_learner_before_the_next() {
        let mut receiver = LinkReceiver::new(7, LAYOUT, 8);
        let mut queue = Queue::default();
        receive(&mut receiver, 1, 1, [1, 3]);
        receive(&mut receiver, 2, 1, [1, 2]);
        receiver.offer(&mut queue).unwrap();
        assert_eq!((receiver.retained(), queue.taken.len()), (5, 3));
        receiver.offer(&mut queue).unwrap();
        assert_eq!(queue.taken.len(), 3, "not before the learner has the first three");
        // A third incarnation has to wait.
        receive(&mut receiver, 3, 2, [1, 1]);
        assert_eq!((receiver.retained(), receiver.ack().rejected_epoch), (5, 2));
        receiver.acknowledge(Watermark { incarnation: 1, sequence: 3 });
        receiver.offer(&mut queue).unwrap();
        assert_eq!(queue.taken, [(1, 1), (1, 2), (1, 3), (2, 1), (2, 2)]);
        receive(&mut receiver, 3, 3, [1, 1]);
        receiver.acknowledge(Watermark { incarnation: 2, sequence: 2 });
        receiver.offer(&mut queue).unwrap();
        assert_eq!((receiver.retained(), queue.taken.last()), (1, Some(&(3, 1))));
    }

    #[test]
    fn segments_that_the_learner_no_longer_takes_do_not_block_a_newer_incarnation() {
        let mut receiver = LinkReceiver::new(7, LAYOUT, 8);
        let mut queue = Queue::default();
        receive(&mut receiver, 1, 1, [1, 3]);
        receive(&mut receiver, 2, 1, [1, 2]);
        receiver.acknowledge(Watermark { incarnation: 2, sequence: 0 });
        receiver.offer(&mut queue).unwrap();
        assert_eq!(queue.taken, [(2, 1), (2, 2)]);
        assert_eq!(receiver.rejected(), 3, "and they are counted");
    }
}
