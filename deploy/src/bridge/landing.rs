//! Receives a worker's segments from a link, at the learner's end.
//!
//! A [`Landing`] takes segments in order and retains them in its own outbox. It offers them to the
//! worker's queue at the learner until the learner has acknowledged them. If the learner dies, they
//! need not cross the link again.

use dmprl_shared::segment::{Segment, SegmentLayout};
use dmprl_shared::transport::delivery::{Mark, Outbox};
use dmprl_shared::transport::{SegmentSender, SendOutcome, TransportError};

use super::lane;
use super::wire::{Hearing, Stretch};

/// Receives the segments of one worker.
#[derive(Debug)]
pub struct Landing {
    worker: u32,
    layout: SegmentLayout,
    capacity: usize,
    outbox: Option<Outbox>,
    /// Segments retained of the worker's previous incarnation. They go first, because the learner
    /// drops them once it knows the newer incarnation.
    older: Option<Outbox>,
    /// The last rejected attempt, in which a segment was missing.
    refused: u32,
    /// Expected sequence number in the current stretch; `None` to skip the stretch.
    expected: Option<u64>,
    mark: Mark,
    misfits: u64,
}

impl Landing {
    /// Creates the landing of a worker from which nothing has been received yet.
    #[must_use]
    pub fn new(worker: u32, layout: SegmentLayout, capacity: usize) -> Self {
        Self {
            worker,
            layout,
            capacity,
            outbox: None,
            older: None,
            refused: 0,
            expected: None,
            mark: Mark::default(),
            misfits: 0,
        }
    }

    /// Segments that contradicted their stretch, or that the learner no longer takes.
    #[must_use]
    pub fn misfits(&self) -> u64 {
        self.misfits
    }

    /// Segments that the learner has not acknowledged.
    #[must_use]
    pub fn kept(&self) -> usize {
        self.older.iter().chain(&self.outbox).map(Outbox::len).sum()
    }

    /// Begins a stretch. If a segment before it is missing, its attempt is rejected, and the host
    /// starts another.
    pub fn begin(&mut self, stretch: &Stretch) {
        self.expected = None;
        if stretch.attempt == self.refused || stretch.first == 0 {
            return;
        }
        let starts = match &self.outbox {
            None => true,
            // The segments in between were acknowledged before they reached this gateway.
            Some(outbox) if stretch.incarnation == outbox.incarnation() => {
                stretch.first > outbox.end()
            }
            Some(outbox) => stretch.incarnation > outbox.incarnation(),
        };
        if starts {
            let room = (self.layout, self.capacity);
            let incarnation = stretch.incarnation;
            let newer = self.outbox.take_if(|outbox| outbox.incarnation() < incarnation);
            if let Some(outbox) = newer.filter(|outbox| !outbox.is_empty()) {
                if self.older.is_some() {
                    // While the learner is away, two incarnations are retained; a third has to
                    // wait.
                    self.outbox = Some(outbox);
                    self.refused = stretch.attempt;
                    return;
                }
                self.older = Some(outbox);
            }
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

    /// Takes a segment of the current stretch.
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
        // A segment that is already here arrives again if another one was missing.
        if expected == outbox.end() && !outbox.put(header, &segment.block) {
            self.refused = stretch.attempt;
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
    pub fn acknowledge(&mut self, mark: Mark) {
        self.mark = mark;
        for outbox in self.older.iter_mut().chain(&mut self.outbox) {
            lane::acknowledge(outbox, mark, (self.layout, self.capacity));
        }
        self.older.take_if(|outbox| outbox.is_empty());
        // The learner already knows a newer incarnation, so it will never take these; retaining
        // them would block the newer one.
        if let Some(of_no_use) = self.older.take_if(|older| older.incarnation() < mark.incarnation)
        {
            self.misfits += of_no_use.len() as u64;
        }
    }

    /// The state of this worker to report to its host.
    #[must_use]
    pub fn hearing(&self) -> Hearing {
        let Mark { incarnation, sequence } = self.mark;
        let landed = self.outbox.as_ref().map_or(0, |outbox| outbox.end() - 1);
        let landed_incarnation = self.outbox.as_ref().map_or(0, Outbox::incarnation);
        let refused = self.refused;
        Hearing { sequence, landed, incarnation, landed_incarnation, refused, reserved: 0 }
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

    fn land(landing: &mut Landing, incarnation: u32, attempt: u32, sequences: [u64; 2]) {
        let [first, last] = sequences;
        let count = (last + 1 - first) as u32;
        let stretch = Stretch { first, next: first, worker: 7, incarnation, attempt, count };
        landing.begin(&stretch);
        for sequence in first..=last {
            let header =
                SegmentHeader { worker_id: 7, incarnation, sequence, ..SegmentHeader::default() };
            landing.land(&stretch, &Segment { header, ..Segment::zeroed(LAYOUT) });
        }
    }

    /// Regression test: after relay and worker have died together, only the gateway has these
    /// segments. They were once dropped.
    #[test]
    fn what_a_dead_start_of_the_worker_left_goes_to_the_learner_before_the_next() {
        let mut landing = Landing::new(7, LAYOUT, 8);
        let mut queue = Queue::default();
        land(&mut landing, 1, 1, [1, 3]);
        land(&mut landing, 2, 1, [1, 2]);
        landing.offer(&mut queue).unwrap();
        assert_eq!((landing.kept(), queue.taken.len()), (5, 3));
        landing.offer(&mut queue).unwrap();
        assert_eq!(queue.taken.len(), 3, "not before the learner has the first three");
        // A third incarnation has to wait.
        land(&mut landing, 3, 2, [1, 1]);
        assert_eq!((landing.kept(), landing.hearing().refused), (5, 2));
        landing.acknowledge(Mark { incarnation: 1, sequence: 3 });
        landing.offer(&mut queue).unwrap();
        assert_eq!(queue.taken, [(1, 1), (1, 2), (1, 3), (2, 1), (2, 2)]);
        land(&mut landing, 3, 3, [1, 1]);
        landing.acknowledge(Mark { incarnation: 2, sequence: 2 });
        landing.offer(&mut queue).unwrap();
        assert_eq!((landing.kept(), queue.taken.last()), (1, Some(&(3, 1))));
    }

    #[test]
    fn what_the_learner_will_not_take_any_more_bars_no_newer_start() {
        let mut landing = Landing::new(7, LAYOUT, 8);
        let mut queue = Queue::default();
        land(&mut landing, 1, 1, [1, 3]);
        land(&mut landing, 2, 1, [1, 2]);
        landing.acknowledge(Mark { incarnation: 2, sequence: 0 });
        landing.offer(&mut queue).unwrap();
        assert_eq!(queue.taken, [(2, 1), (2, 2)]);
        assert_eq!(landing.misfits(), 3, "and they are counted");
    }
}
