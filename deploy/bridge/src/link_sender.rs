//! Sends a worker's segments over the link, at the host's end.
//!
//! Like the worker's own outbox, a [`LinkSender`] retains the segments that the learner has not
//! acknowledged, and sends them in order. A link that breaks may lose the segments in flight. The
//! gateway then detects the gap and rejects the retransmit epoch; the sender begins the next epoch
//! and sends all retained segments again. So no segment is lost, and the receiver drops duplicates.

use std::time::Instant;

use dmprl_shared::segment::{Segment, SegmentHeader, SegmentLayout};
use dmprl_shared::transport::delivery::{Outbox, Watermark};
use dmprl_shared::transport::{SegmentSender, SendOutcome, TransportError};

use super::wire::{Batch, LinkAck, SegmentRange};

/// Sends the segments of one worker.
#[derive(Debug)]
pub struct LinkSender {
    /// Index of the worker in the run, which differs from its index on this host.
    worker: u32,
    layout: SegmentLayout,
    capacity: usize,
    outbox: Option<Outbox>,
    /// First segment of the worker's new incarnation. It waits until the previous incarnation is
    /// acknowledged completely, because the learner drops segments of older incarnations.
    pending: Option<Segment>,
    /// Number of times that all retained segments were sent again, from 1.
    retransmit_epoch: u32,
    /// Set until the retained segments are sent again in the current epoch.
    retransmit_due: bool,
    /// The segment whose round trip is being timed, and when it was sent.
    timed: Option<(u64, Instant)>,
    rejected: u64,
}

/// Effect of an acknowledgement.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Acked {
    /// Number of segments acknowledged.
    pub segments: u64,
    /// Time from sending a segment until the gateway confirmed it, if one was timed \[s\].
    pub round_trip_s: Option<f64>,
}

impl LinkSender {
    /// Creates the sender of a worker that has sent nothing yet.
    #[must_use]
    pub fn new(worker: u32, layout: SegmentLayout, capacity: usize) -> Self {
        Self {
            worker,
            layout,
            capacity,
            outbox: None,
            pending: None,
            retransmit_epoch: 1,
            retransmit_due: false,
            timed: None,
            rejected: 0,
        }
    }

    /// Returns true if another segment of the worker can be taken, that is, none waits to be sent.
    #[must_use]
    pub fn has_room(&self) -> bool {
        let free = |outbox: &Outbox| outbox.unsent() == 0 && outbox.len() < outbox.capacity();
        self.pending.is_none() && !self.retransmit_due && self.outbox.as_ref().is_none_or(free)
    }

    /// Number of segments in flight.
    #[must_use]
    pub fn in_flight(&self) -> usize {
        self.outbox.as_ref().map_or(0, Outbox::in_flight)
    }

    /// Number of retained segments.
    #[cfg(test)]
    pub(super) fn retained(&self) -> usize {
        self.outbox.as_ref().map_or(0, Outbox::len) + usize::from(self.pending.is_some())
    }

    /// Segments that did not follow their predecessor. A correct worker sends none.
    #[must_use]
    pub fn rejected(&self) -> u64 {
        self.rejected
    }

    /// Takes a segment from the worker. Skips a segment that is already retained: a worker
    /// retransmits after a reconnection.
    pub fn take(&mut self, segment: &Segment) {
        let header = SegmentHeader { worker_id: self.worker, ..segment.header };
        let newer = match &self.outbox {
            None => true,
            Some(outbox) if header.incarnation > outbox.incarnation() => {
                if !outbox.is_empty() {
                    self.pending = Some(Segment { header, block: segment.block.clone() });
                    return;
                }
                true
            }
            Some(outbox) if header.incarnation < outbox.incarnation() => return,
            Some(_) => false,
        };
        if newer {
            self.begin_incarnation(&header);
        }
        let Some(outbox) = &mut self.outbox else { return };
        if header.sequence < outbox.end() {
            return;
        }
        let fits = header.sequence == outbox.end() && outbox.put(&header, &segment.block);
        self.rejected += u64::from(!fits);
    }

    fn begin_incarnation(&mut self, header: &SegmentHeader) {
        let first = header.sequence.max(1);
        let outbox =
            Outbox::starting_at(first, self.layout, self.capacity, self.worker, header.incarnation);
        self.outbox = Some(outbox);
        self.retransmit_due = false;
        self.timed = None;
    }

    /// Moves waiting segments into the batch, up to `room` \[segments\].
    pub fn send(&mut self, batch: &mut Batch, room: &mut usize, now: Instant) {
        let Some(range) = self.range() else { return };
        let Some(outbox) = &mut self.outbox else { return };
        let mut queue = BatchQueue {
            batch,
            room,
            retransmit_due: &mut self.retransmit_due,
            range,
            has_begun: false,
        };
        // Adding to a batch only fails for lack of room.
        let _ = outbox.offer(&mut queue);
        // A segment sent in an earlier turn would seem to have a shorter round trip.
        if queue.has_begun && self.timed.is_none() {
            self.timed = Some((outbox.first() + outbox.in_flight() as u64 - 1, now));
        }
    }

    /// Tells the gateway the worker's last sequence number. Without it, the gateway would not
    /// notice that the last segments were lost.
    pub fn report_progress(&self, batch: &mut Batch) {
        if let Some(range) = self.range() {
            batch.begin(range);
        }
    }

    /// An empty range at the next segment to send; none before the first segment.
    fn range(&self) -> Option<SegmentRange> {
        let outbox = self.outbox.as_ref()?;
        Some(SegmentRange {
            oldest: outbox.first(),
            start: outbox.first() + outbox.in_flight() as u64,
            worker: self.worker,
            incarnation: outbox.incarnation(),
            retransmit_epoch: self.retransmit_epoch,
            count: 0,
        })
    }

    /// Begins a retransmit epoch: sends all retained segments again.
    pub fn begin_retransmit(&mut self) {
        self.retransmit_epoch = self.retransmit_epoch.wrapping_add(1).max(1);
        // If nothing is retained, nothing can be missing.
        self.retransmit_due = self.outbox.is_some();
        self.timed = None;
    }

    /// Processes the gateway's acknowledgement: drops acknowledged segments, and begins a
    /// retransmit epoch if a segment is missing.
    pub fn acknowledge(&mut self, ack: &LinkAck, now: Instant) -> Acked {
        let mut acked = Acked::default();
        if let Some(outbox) = &mut self.outbox {
            let before = outbox.first();
            drop_acknowledged(outbox, ack.mark());
            acked.segments = outbox.first() - before;
            let is_current = ack.received_incarnation == outbox.incarnation();
            let confirmed = self.timed.filter(|(last, _)| is_current && *last <= ack.received);
            if let Some((_, since)) = confirmed {
                acked.round_trip_s = Some(now.duration_since(since).as_secs_f64());
                self.timed = None;
            }
        }
        if ack.rejected_epoch == self.retransmit_epoch {
            self.begin_retransmit();
        }
        let done = self.outbox.as_ref().is_none_or(Outbox::is_empty);
        if done && let Some(segment) = self.pending.take() {
            self.begin_incarnation(&segment.header);
            self.take(&segment);
        }
        acked
    }

    /// The mark up to which the worker may drop segments.
    #[must_use]
    pub fn mark(&self) -> Watermark {
        self.outbox.as_ref().map_or(Watermark::default(), |outbox| Watermark {
            incarnation: outbox.incarnation(),
            sequence: outbox.first() - 1,
        })
    }
}

/// Drops the segments that the learner has. The mark is beyond the outbox if the previous relay or
/// gateway died after it passed segments on. The worker's retransmits of these are then skipped.
pub(super) fn drop_acknowledged(outbox: &mut Outbox, mark: Watermark) {
    if mark.incarnation == outbox.incarnation() && mark.sequence >= outbox.end() {
        outbox.skip_to(mark.sequence + 1);
    } else {
        outbox.acknowledge_to(mark);
    }
}

/// A batch as the queue to which an outbox offers its segments.
struct BatchQueue<'a> {
    batch: &'a mut Batch,
    room: &'a mut usize,
    retransmit_due: &'a mut bool,
    /// The range to begin with the first segment.
    range: SegmentRange,
    has_begun: bool,
}

impl SegmentSender for BatchQueue<'_> {
    fn renew(&mut self) -> Result<bool, TransportError> {
        Ok(std::mem::take(self.retransmit_due))
    }

    fn try_send(
        &mut self,
        header: &SegmentHeader,
        block: &[f32],
    ) -> Result<SendOutcome, TransportError> {
        if *self.room == 0 {
            return Ok(SendOutcome::Full);
        }
        *self.room -= 1;
        if !self.has_begun {
            self.has_begun = true;
            self.batch.begin(SegmentRange { start: header.sequence, ..self.range });
        }
        self.batch.add(header, block);
        Ok(SendOutcome::Delivered)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link_receiver::LinkReceiver;
    use crate::wire::read_batch;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 1, observation_len: 1, action_len: 1 };

    fn segment(incarnation: u32, sequence: u64) -> Segment {
        let header = SegmentHeader { incarnation, sequence, ..SegmentHeader::default() };
        Segment { header, ..Segment::zeroed(LAYOUT) }
    }

    /// Delivers a batch to the receiver.
    fn deliver(batch: &mut Batch, receiver: &mut LinkReceiver) {
        let mut buffer = Segment::zeroed(LAYOUT);
        read_batch(&batch.take(), &mut buffer, |range, segment| match segment {
            None => receiver.begin(range),
            Some(segment) => receiver.receive(range, segment),
        })
        .unwrap();
    }

    struct Ends {
        sender: LinkSender,
        receiver: LinkReceiver,
        batch: Batch,
        now: Instant,
    }

    impl Ends {
        fn new() -> Self {
            let (sender, receiver) =
                (LinkSender::new(7, LAYOUT, 8), LinkReceiver::new(7, LAYOUT, 8));
            Self { sender, receiver, batch: Batch::default(), now: Instant::now() }
        }

        fn send(&mut self, incarnation: u32, sequences: std::ops::RangeInclusive<u64>) {
            sequences.for_each(|sequence| self.sender.take(&segment(incarnation, sequence)));
            self.send_rest();
        }

        fn send_rest(&mut self) {
            self.sender.send(&mut self.batch, &mut 100, self.now);
        }

        fn deliver(&mut self) {
            deliver(&mut self.batch, &mut self.receiver);
        }

        fn acknowledge(&mut self, incarnation: u32, sequence: u64) -> Acked {
            self.receiver.acknowledge(Watermark { incarnation, sequence });
            self.sender.acknowledge(&self.receiver.ack(), self.now)
        }
    }

    #[test]
    fn segments_lost_on_the_link_are_retransmitted() {
        let mut ends = Ends::new();
        ends.send(0, 1..=2);
        ends.deliver();
        ends.send(0, 3..=4);
        drop(ends.batch.take());
        assert_eq!(ends.receiver.retained(), 2);
        // No later segment would reveal the gap: the sender reports its last sequence number.
        ends.sender.report_progress(&mut ends.batch);
        ends.deliver();
        assert_ne!(ends.receiver.ack().rejected_epoch, 0);
        ends.acknowledge(0, 0);
        assert!(!ends.sender.has_room(), "retained segments go first");
        ends.send_rest();
        ends.deliver();
        assert_eq!(ends.receiver.retained(), 4);
        assert_eq!(ends.acknowledge(0, 4).segments, 4);
        assert_eq!(
            (ends.sender.retained(), ends.receiver.retained(), ends.sender.rejected()),
            (0, 0, 0)
        );
        assert_eq!(ends.sender.mark(), Watermark { incarnation: 0, sequence: 4 });
    }

    #[test]
    fn a_new_receiver_begins_with_the_oldest_retained_segment() {
        let mut ends = Ends::new();
        ends.send(0, 1..=5);
        ends.deliver();
        ends.acknowledge(0, 2);
        ends.receiver = LinkReceiver::new(7, LAYOUT, 8);
        ends.send(0, 6..=6);
        ends.deliver();
        assert_eq!(ends.receiver.retained(), 0, "3 to 5 are missing");
        ends.acknowledge(0, 2);
        ends.send_rest();
        ends.deliver();
        assert_eq!(ends.receiver.retained(), 4);
    }

    /// Regression test: the worker retransmits from the last acknowledgement it heard, but the
    /// learner has more. The sender once waited forever for an acknowledgement of segments it had
    /// not received yet.
    #[test]
    fn a_new_sender_accepts_a_mark_beyond_the_segments_it_has_seen() {
        let mut ends = Ends::new();
        ends.send(0, 1..=8);
        ends.deliver();
        ends.receiver.acknowledge(Watermark { incarnation: 0, sequence: 7 });
        ends.sender = LinkSender::new(7, LAYOUT, 8);
        ends.sender.begin_retransmit();
        ends.send(0, 3..=5);
        assert_eq!(ends.sender.in_flight(), 3);
        ends.deliver();
        ends.acknowledge(0, 7);
        assert_eq!(ends.sender.mark(), Watermark { incarnation: 0, sequence: 7 });
        assert_eq!(ends.sender.in_flight(), 0);
        ends.send(0, 6..=9);
        ends.deliver();
        assert_eq!((ends.sender.retained(), ends.receiver.retained()), (2, 2));
    }

    /// Regression test: a long link once seemed to delay its segments, and the window stayed small.
    #[test]
    fn a_turn_that_sends_nothing_times_nothing() {
        let mut ends = Ends::new();
        ends.send(0, 1..=2);
        ends.deliver();
        let second = std::time::Duration::from_secs(1);
        ends.now += second;
        assert_eq!(ends.acknowledge(0, 1), Acked { segments: 1, round_trip_s: Some(1.0) });
        ends.send_rest();
        ends.now += second;
        assert_eq!(ends.acknowledge(0, 2), Acked { segments: 1, round_trip_s: None });
    }

    #[test]
    fn a_new_incarnation_waits_until_the_previous_is_acknowledged() {
        let mut ends = Ends::new();
        ends.send(3, 1..=2);
        ends.deliver();
        ends.send(4, 1..=1);
        ends.deliver();
        assert!(!ends.sender.has_room());
        assert_eq!((ends.sender.retained(), ends.receiver.retained()), (3, 2));
        ends.acknowledge(3, 2);
        ends.send(4, 2..=2);
        ends.deliver();
        assert_eq!(ends.receiver.retained(), 2);
        ends.acknowledge(4, 2);
        assert_eq!(ends.sender.mark(), Watermark { incarnation: 4, sequence: 2 });
    }
}
