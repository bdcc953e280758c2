//! A worker's queue with injected faults.

use std::collections::VecDeque;

use dmprl_shared::segment::{Segment, SegmentHeader};
use dmprl_shared::transport::{SegmentSender, SendOutcome, TransportError};
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;

/// A queue with the worst behaviour that shared memory allows.
pub struct Link {
    random: Xoshiro256PlusPlus,
    pub faults: bool,
    /// Queued segments. The queue of a dead learner still accepts segments.
    pub queue: VecDeque<Segment>,
    capacity: usize,
    epoch: u64,
    connected: u64,
    pub drops: u64,
    pub repetitions: u64,
    pub renewals: u64,
}

impl Link {
    pub fn new(random: Xoshiro256PlusPlus, capacity: usize) -> Self {
        Self {
            random,
            faults: true,
            queue: VecDeque::new(),
            capacity,
            epoch: 0,
            connected: 0,
            drops: 0,
            repetitions: 0,
            renewals: 0,
        }
    }

    /// Starts a learner, which discards the previous one's queue.
    pub fn new_learner(&mut self, epoch: u64) {
        self.epoch = epoch;
        self.queue.clear();
    }

    fn chance(&mut self, one_in: u32) -> bool {
        self.faults && self.random.random_range(0..one_in) == 0
    }
}

impl SegmentSender for Link {
    fn renew(&mut self) -> Result<bool, TransportError> {
        let broke = self.chance(30);
        if broke {
            self.renewals += 1;
            // The queue's content may be lost or not.
            if self.chance(2) {
                self.queue.clear();
            }
        }
        let is_new = self.connected != self.epoch;
        self.connected = self.epoch;
        Ok(is_new || broke)
    }

    fn try_send(
        &mut self,
        header: &SegmentHeader,
        block: &[f32],
    ) -> Result<SendOutcome, TransportError> {
        if self.chance(20) {
            // The case in which iceoryx2 returns Ok(0).
            self.drops += 1;
            return Ok(SendOutcome::Detached);
        }
        // The connection still belongs to the previous learner.
        if self.connected != self.epoch {
            return Ok(SendOutcome::Detached);
        }
        if self.queue.len() >= self.capacity {
            return Ok(SendOutcome::Full);
        }
        let segment = Segment { header: *header, block: block.to_vec() };
        if self.chance(20) {
            self.repetitions += 1;
            self.queue.push_back(segment.clone());
        }
        self.queue.push_back(segment);
        Ok(SendOutcome::Delivered)
    }
}
