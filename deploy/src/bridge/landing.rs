//! A worker's segments on their way over a link, from the learner's end.
//!
//! A [`Landing`] takes them in order and keeps them in an outbox of its own, which offers them to
//! the worker's queue at the learner until that has acknowledged them: when the learner dies, they
//! are here, and need not come over the link again.

use dmprl_shared::segment::{Segment, SegmentLayout};
use dmprl_shared::transport::delivery::{Mark, Outbox};
use dmprl_shared::transport::{SegmentSender, SendOutcome, TransportError};

use super::lane;
use super::wire::{Hearing, Stretch};

/// One worker's.
#[derive(Debug)]
pub struct Landing {
    worker: u32,
    layout: SegmentLayout,
    capacity: usize,
    outbox: Option<Outbox>,
    /// The attempt in which something was missing.
    refused: u32,
    /// The segment that follows in the stretch that is being read; none: it is passed over.
    expected: Option<u64>,
    mark: Mark,
    misfits: u64,
}

impl Landing {
    /// Nothing has come of the worker yet.
    #[must_use]
    pub fn new(worker: u32, layout: SegmentLayout, capacity: usize) -> Self {
        let (outbox, expected, mark) = (None, None, Mark::default());
        Self { worker, layout, capacity, outbox, refused: 0, expected, mark, misfits: 0 }
    }

    /// Segments that were not what their stretch said.
    #[must_use]
    pub fn misfits(&self) -> u64 {
        self.misfits
    }

    /// Segments that the learner has not acknowledged.
    #[must_use]
    pub fn kept(&self) -> usize {
        self.outbox.as_ref().map_or(0, Outbox::len)
    }

    /// A stretch begins. Where something is missing before it, its attempt is refused, and the host
    /// begins another.
    pub fn begin(&mut self, stretch: &Stretch) {
        self.expected = None;
        if stretch.attempt == self.refused || stretch.first == 0 {
            return;
        }
        let starts = match &self.outbox {
            None => true,
            // What lies between was acknowledged before it came to this gateway.
            Some(outbox) if stretch.incarnation == outbox.incarnation() => {
                stretch.first > outbox.end()
            }
            Some(outbox) => stretch.incarnation > outbox.incarnation(),
        };
        if starts {
            let room = (self.layout, self.capacity);
            let incarnation = stretch.incarnation;
            self.outbox = Some(Outbox::starting_at(stretch.first, room, self.worker, incarnation));
        }
        let Some(outbox) = &self.outbox else { return };
        if stretch.incarnation < outbox.incarnation() {
            return;
        }
        if stretch.next > outbox.end() {
            self.refused = stretch.attempt;
            return;
        }
        self.expected = Some(stretch.next);
    }

    /// A segment of the stretch begun last.
    pub fn land(&mut self, stretch: &Stretch, segment: &Segment) {
        let (Some(expected), Some(outbox)) = (self.expected, &mut self.outbox) else { return };
        let header = &segment.header;
        let is = (header.worker_id, header.incarnation, header.sequence);
        if is != (self.worker, outbox.incarnation(), expected) {
            self.misfits += 1;
            self.expected = None;
            return;
        }
        self.expected = Some(expected + 1);
        // One that is here already comes again when others were missing.
        if expected == outbox.end() && !outbox.put(header, &segment.block) {
            self.refused = stretch.attempt;
            self.expected = None;
        }
    }

    /// Offers the learner what it has not taken.
    ///
    /// # Errors
    /// Those of the queue.
    pub fn offer(&mut self, queue: &mut impl SegmentSender) -> Result<SendOutcome, TransportError> {
        match &mut self.outbox {
            Some(outbox) if !outbox.is_empty() => outbox.offer(queue),
            _ => Ok(SendOutcome::Delivered),
        }
    }

    /// The learner has acknowledged so much.
    pub fn acknowledge(&mut self, mark: Mark) {
        self.mark = mark;
        if let Some(outbox) = &mut self.outbox {
            lane::acknowledge(outbox, mark, (self.layout, self.capacity));
        }
    }

    /// What the host is to know.
    #[must_use]
    pub fn hearing(&self) -> Hearing {
        let Mark { incarnation, sequence } = self.mark;
        let landed = self.outbox.as_ref().map_or(0, |outbox| outbox.end() - 1);
        let landed_incarnation = self.outbox.as_ref().map_or(0, Outbox::incarnation);
        let refused = self.refused;
        Hearing { sequence, landed, incarnation, landed_incarnation, refused, reserved: 0 }
    }
}
