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
    /// What is kept of the start of the worker before: the learner takes nothing of it any more
    /// once it knows the newer, so it goes first.
    older: Option<Outbox>,
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

    /// Segments that were not what their stretch said, or that the learner will not take.
    #[must_use]
    pub fn misfits(&self) -> u64 {
        self.misfits
    }

    /// Segments that the learner has not acknowledged.
    #[must_use]
    pub fn kept(&self) -> usize {
        self.older.iter().chain(&self.outbox).map(Outbox::len).sum()
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
            let newer = self.outbox.take_if(|outbox| outbox.incarnation() < incarnation);
            if let Some(outbox) = newer.filter(|outbox| !outbox.is_empty()) {
                if self.older.is_some() {
                    // Two starts in the time of a learner's absence are kept, a third comes later.
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
        match self.older.as_mut().or(self.outbox.as_mut()) {
            Some(outbox) if !outbox.is_empty() => outbox.offer(queue),
            _ => Ok(SendOutcome::Delivered),
        }
    }

    /// The learner has acknowledged so much.
    pub fn acknowledge(&mut self, mark: Mark) {
        self.mark = mark;
        for outbox in self.older.iter_mut().chain(&mut self.outbox) {
            lane::acknowledge(outbox, mark, (self.layout, self.capacity));
        }
        self.older.take_if(|outbox| outbox.is_empty());
        // The learner knows a newer start, by whatever way: kept, these would bar that one's.
        if let Some(of_no_use) = self.older.take_if(|older| older.incarnation() < mark.incarnation)
        {
            self.misfits += of_no_use.len() as u64;
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

#[cfg(test)]
mod tests {
    use dmprl_shared::segment::SegmentHeader;

    use super::*;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 1, observation_len: 1, action_len: 1 };

    /// A queue that takes everything.
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

    /// Its relay and worker died together, so nobody else has them; they were thrown away once.
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
        // A third start has to wait.
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
