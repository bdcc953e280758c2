//! Sends a worker's segments over a link, at the host's end.
//!
//! A [`Lane`] is an outbox like the worker's own. It retains the segments that the learner has not
//! acknowledged, and offers them to the link in order. A link that breaks may lose the segments in
//! flight. The gateway then detects the gap and rejects the attempt, and the lane retransmits
//! everything it retains as the next attempt. Thus no segment is lost, and the receiver drops
//! duplicates.

use std::time::Instant;

use dmprl_shared::segment::{Segment, SegmentHeader, SegmentLayout};
use dmprl_shared::transport::delivery::{Mark, Outbox};
use dmprl_shared::transport::{SegmentSender, SendOutcome, TransportError};

use super::wire::{Batch, Hearing, Stretch};

/// Sends the segments of one worker.
#[derive(Debug)]
pub struct Lane {
    /// Index of the worker in the run, which differs from its index on this host.
    worker: u32,
    layout: SegmentLayout,
    capacity: usize,
    outbox: Option<Outbox>,
    /// First segment of the worker's new incarnation. It waits until the previous incarnation is
    /// acknowledged completely, because the learner drops segments of older incarnations.
    pending: Option<Segment>,
    attempt: u32,
    anew: bool,
    /// The segment whose round trip is being timed, and when it was sent.
    timed: Option<(u64, Instant)>,
    misfits: u64,
}

/// Effect of an acknowledgement.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Acked {
    /// Number of segments acknowledged.
    pub segments: u64,
    /// Time from sending a segment to the news of its landing, if one was timed \[s\].
    pub round_trip_s: Option<f64>,
}

impl Lane {
    /// Creates the lane of a worker from which nothing has been received yet.
    #[must_use]
    pub fn new(worker: u32, layout: SegmentLayout, capacity: usize) -> Self {
        let (outbox, pending, timed) = (None, None, None);
        Self {
            worker,
            layout,
            capacity,
            outbox,
            pending,
            attempt: 1,
            anew: false,
            timed,
            misfits: 0,
        }
    }

    /// Returns true if another segment of the worker can be taken, that is, none waits to be sent.
    #[must_use]
    pub fn has_room(&self) -> bool {
        let free = |outbox: &Outbox| outbox.unsent() == 0 && outbox.len() < outbox.capacity();
        self.pending.is_none() && !self.anew && self.outbox.as_ref().is_none_or(free)
    }

    /// Number of segments in flight.
    #[must_use]
    pub fn under_way(&self) -> usize {
        self.outbox.as_ref().map_or(0, Outbox::under_way)
    }

    /// Number of retained segments.
    #[must_use]
    pub fn kept(&self) -> usize {
        self.outbox.as_ref().map_or(0, Outbox::len) + usize::from(self.pending.is_some())
    }

    /// Segments that did not follow their predecessor. A correct worker sends none.
    #[must_use]
    pub fn misfits(&self) -> u64 {
        self.misfits
    }

    /// Takes a segment from the worker. After a reconnection it retransmits segments that are
    /// already here.
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
            self.begin(&header);
        }
        let Some(outbox) = &mut self.outbox else { return };
        if header.sequence < outbox.end() {
            return;
        }
        let fits = header.sequence == outbox.end() && outbox.put(&header, &segment.block);
        self.misfits += u64::from(!fits);
    }

    fn begin(&mut self, header: &SegmentHeader) {
        let room = (self.layout, self.capacity);
        let first = header.sequence.max(1);
        self.outbox = Some(Outbox::starting_at(first, room, self.worker, header.incarnation));
        self.anew = false;
        self.timed = None;
    }

    /// Moves waiting segments into the batch, up to `room` \[segments\].
    pub fn send(&mut self, batch: &mut Batch, room: &mut usize, now: Instant) {
        let Some(outbox) = &mut self.outbox else { return };
        let (first, incarnation) = (outbox.first(), outbox.incarnation());
        let stretch = Stretch {
            first,
            next: 0,
            worker: self.worker,
            incarnation,
            attempt: self.attempt,
            count: 0,
        };
        let mut link = Boarding { batch, room, anew: &mut self.anew, stretch, begun: false };
        // Boarding only fails for lack of room.
        let _ = outbox.offer(&mut link);
        // A segment sent in an earlier turn would seem to have a shorter round trip.
        if link.begun && self.timed.is_none() {
            self.timed = Some((first + outbox.under_way() as u64 - 1, now));
        }
    }

    /// Tells the gateway the worker's last sequence number. Otherwise a segment lost at the end
    /// would not be noticed.
    pub fn say_how_far(&self, batch: &mut Batch) {
        let Some(outbox) = &self.outbox else { return };
        batch.begin(Stretch {
            first: outbox.first(),
            next: outbox.first() + outbox.under_way() as u64,
            worker: self.worker,
            incarnation: outbox.incarnation(),
            attempt: self.attempt,
            count: 0,
        });
    }

    /// Retransmits all retained segments, because there is a new gateway.
    pub fn begin_anew(&mut self) {
        self.attempt = self.attempt.wrapping_add(1).max(1);
        // If nothing is retained, nothing can be missing.
        self.anew = self.outbox.is_some();
        self.timed = None;
    }

    /// Processes a hearing: the segments that the gateway has and that the learner has
    /// acknowledged.
    pub fn hear(&mut self, hearing: &Hearing, now: Instant) -> Acked {
        let mut acked = Acked::default();
        if let Some(outbox) = &mut self.outbox {
            let before = outbox.first();
            acknowledge(outbox, hearing.mark(), (self.layout, self.capacity));
            acked.segments = outbox.first() - before;
            let here = hearing.landed_incarnation == outbox.incarnation();
            let landed = self.timed.filter(|(last, _)| here && *last <= hearing.landed);
            if let Some((_, since)) = landed {
                acked.round_trip_s = Some(now.duration_since(since).as_secs_f64());
                self.timed = None;
            }
        }
        if hearing.refused == self.attempt {
            self.begin_anew();
        }
        let done = self.outbox.as_ref().is_none_or(Outbox::is_empty);
        if done && let Some(segment) = self.pending.take() {
            self.begin(&segment.header);
            self.take(&segment);
        }
        acked
    }

    /// The mark up to which the worker may drop segments.
    #[must_use]
    pub fn mark(&self) -> Mark {
        self.outbox.as_ref().map_or(Mark::default(), |outbox| Mark {
            incarnation: outbox.incarnation(),
            sequence: outbox.first() - 1,
        })
    }
}

/// Drops the segments that the learner has. The mark may be beyond the outbox if the previous relay
/// or gateway died after it passed them on. Then the worker's retransmits of them are skipped.
pub(super) fn acknowledge(outbox: &mut Outbox, mark: Mark, room: (SegmentLayout, usize)) {
    let (worker, incarnation) = (outbox.worker_id(), outbox.incarnation());
    if mark.incarnation == incarnation && mark.sequence >= outbox.end() {
        *outbox = Outbox::starting_at(mark.sequence + 1, room, worker, incarnation);
    } else {
        outbox.acknowledge_to(mark);
    }
}

/// Presents a batch as the queue of an outbox.
struct Boarding<'a> {
    batch: &'a mut Batch,
    room: &'a mut usize,
    anew: &'a mut bool,
    stretch: Stretch,
    begun: bool,
}

impl SegmentSender for Boarding<'_> {
    fn renew(&mut self) -> Result<bool, TransportError> {
        Ok(std::mem::take(self.anew))
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
        if !self.begun {
            self.begun = true;
            self.batch.begin(Stretch { next: header.sequence, ..self.stretch });
        }
        self.batch.add(header, block);
        Ok(SendOutcome::Delivered)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bridge::landing::Landing;
    use crate::bridge::wire::read_batch;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 1, observation_len: 1, action_len: 1 };

    fn segment(incarnation: u32, sequence: u64) -> Segment {
        let header = SegmentHeader { incarnation, sequence, ..SegmentHeader::default() };
        Segment { header, ..Segment::zeroed(LAYOUT) }
    }

    /// Lands everything that a batch holds.
    fn land(batch: &mut Batch, landing: &mut Landing) {
        let mut buffer = Segment::zeroed(LAYOUT);
        read_batch(&batch.take(), &mut buffer, |stretch, segment| match segment {
            None => landing.begin(stretch),
            Some(segment) => landing.land(stretch, segment),
        })
        .unwrap();
    }

    struct Ends {
        lane: Lane,
        landing: Landing,
        batch: Batch,
        now: Instant,
    }

    impl Ends {
        fn new() -> Self {
            let (lane, landing) = (Lane::new(7, LAYOUT, 8), Landing::new(7, LAYOUT, 8));
            Self { lane, landing, batch: Batch::default(), now: Instant::now() }
        }

        fn send(&mut self, incarnation: u32, sequences: std::ops::RangeInclusive<u64>) {
            sequences.for_each(|sequence| self.lane.take(&segment(incarnation, sequence)));
            self.send_rest();
        }

        fn send_rest(&mut self) {
            self.lane.send(&mut self.batch, &mut 100, self.now);
        }

        fn land(&mut self) {
            land(&mut self.batch, &mut self.landing);
        }

        fn acknowledge(&mut self, incarnation: u32, sequence: u64) -> Acked {
            self.landing.acknowledge(Mark { incarnation, sequence });
            self.lane.hear(&self.landing.hearing(), self.now)
        }
    }

    #[test]
    fn what_the_link_lost_is_found_missing_and_sent_again() {
        let mut ends = Ends::new();
        ends.send(0, 1..=2);
        ends.land();
        ends.send(0, 3..=4);
        drop(ends.batch.take());
        assert_eq!(ends.landing.kept(), 2);
        // No later segment would reveal the gap: the lane reports its last sequence number.
        ends.lane.say_how_far(&mut ends.batch);
        ends.land();
        assert_ne!(ends.landing.hearing().refused, 0);
        ends.acknowledge(0, 0);
        assert!(!ends.lane.has_room(), "what is kept goes first");
        ends.send_rest();
        ends.land();
        assert_eq!(ends.landing.kept(), 4);
        assert_eq!(ends.acknowledge(0, 4).segments, 4);
        assert_eq!((ends.lane.kept(), ends.landing.kept(), ends.lane.misfits()), (0, 0, 0));
        assert_eq!(ends.lane.mark(), Mark { incarnation: 0, sequence: 4 });
    }

    #[test]
    fn a_landing_that_takes_over_begins_with_the_oldest_that_is_kept() {
        let mut ends = Ends::new();
        ends.send(0, 1..=5);
        ends.land();
        ends.acknowledge(0, 2);
        ends.landing = Landing::new(7, LAYOUT, 8);
        ends.send(0, 6..=6);
        ends.land();
        assert_eq!(ends.landing.kept(), 0, "3 to 5 are missing");
        ends.acknowledge(0, 2);
        ends.send_rest();
        ends.land();
        assert_eq!(ends.landing.kept(), 4);
    }

    /// Regression test: the worker retransmits from the last acknowledgement it heard, but the
    /// learner has more. The lane once waited forever for an acknowledgement of segments it had not
    /// received yet.
    #[test]
    fn a_lane_that_takes_over_believes_a_mark_beyond_what_it_has_seen() {
        let mut ends = Ends::new();
        ends.send(0, 1..=8);
        ends.land();
        ends.landing.acknowledge(Mark { incarnation: 0, sequence: 7 });
        ends.lane = Lane::new(7, LAYOUT, 8);
        ends.lane.begin_anew();
        ends.send(0, 3..=5);
        assert_eq!(ends.lane.under_way(), 3);
        ends.land();
        ends.acknowledge(0, 7);
        assert_eq!(ends.lane.mark(), Mark { incarnation: 0, sequence: 7 });
        assert_eq!(ends.lane.under_way(), 0);
        ends.send(0, 6..=9);
        ends.land();
        assert_eq!((ends.lane.kept(), ends.landing.kept()), (2, 2));
    }

    /// Regression test: a long link once seemed to delay its segments, and the window stayed small.
    #[test]
    fn what_was_sent_before_is_not_timed_as_if_it_were_sent_now() {
        let mut ends = Ends::new();
        ends.send(0, 1..=2);
        ends.land();
        let second = std::time::Duration::from_secs(1);
        ends.now += second;
        assert_eq!(ends.acknowledge(0, 1), Acked { segments: 1, round_trip_s: Some(1.0) });
        ends.send_rest();
        ends.now += second;
        assert_eq!(ends.acknowledge(0, 2), Acked { segments: 1, round_trip_s: None });
    }

    #[test]
    fn a_new_start_of_the_worker_waits_until_all_of_the_old_is_acknowledged() {
        let mut ends = Ends::new();
        ends.send(3, 1..=2);
        ends.land();
        ends.send(4, 1..=1);
        ends.land();
        assert!(!ends.lane.has_room());
        assert_eq!((ends.lane.kept(), ends.landing.kept()), (3, 2));
        ends.acknowledge(3, 2);
        ends.send(4, 2..=2);
        ends.land();
        assert_eq!(ends.landing.kept(), 2);
        ends.acknowledge(4, 2);
        assert_eq!(ends.lane.mark(), Mark { incarnation: 4, sequence: 2 });
    }
}
