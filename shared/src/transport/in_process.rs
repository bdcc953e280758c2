//! Segment queues, the parameter channel and the acknowledgement channel inside one process.
//!
//! They are bounded like those in shared memory and pass the same contract test. Buffers circulate
//! between a free list and the queue, so nothing is allocated after construction.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::delivery::{Acknowledgements, Watermark};
use super::{
    AcknowledgementPublisher, AcknowledgementSubscriber, ParameterPublisher, ParameterSubscriber,
    SegmentReceiver, SegmentSender, SendOutcome, TransportError, WorkerTransport,
};
use crate::parameters::{ParameterSnapshot, SnapshotError};
use crate::segment::{Segment, SegmentHeader, SegmentLayout};

/// The types of this transport.
#[derive(Debug)]
pub struct InProcess;

impl WorkerTransport for InProcess {
    type Segments = Sender;
    type Parameters = Subscriber;
    type Acknowledgements = AcknowledgementReader;
}

/// Number of the learner. A session inside one process has only one.
const EPOCH: u64 = 1;

#[derive(Debug)]
struct Queue {
    full: VecDeque<Segment>,
    free: Vec<Segment>,
    block_len: usize,
    attached: bool,
}

/// Locks a mutex and ignores poisoning: the data is consistent after every statement, even if a
/// thread panics while it holds the lock.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A worker's end of its queue.
#[derive(Debug)]
pub struct Sender(Arc<Mutex<Queue>>);

/// The learner's end of all queues.
#[derive(Debug)]
pub struct Receiver {
    queues: Vec<Arc<Mutex<Queue>>>,
    next: usize,
}

/// Creates one queue of `capacity` segments for each of `workers` workers.
#[must_use]
pub fn segment_queues(
    workers: usize,
    capacity: usize,
    layout: SegmentLayout,
) -> (Vec<Sender>, Receiver) {
    let queue = || {
        Arc::new(Mutex::new(Queue {
            full: VecDeque::with_capacity(capacity),
            free: (0..capacity).map(|_| Segment::zeroed(layout)).collect(),
            block_len: layout.block_len(),
            attached: true,
        }))
    };
    let queues: Vec<_> = (0..workers).map(|_| queue()).collect();
    (queues.iter().cloned().map(Sender).collect(), Receiver { queues, next: 0 })
}

impl SegmentSender for Sender {
    /// Does nothing, because the connection never breaks.
    fn renew(&mut self) -> Result<bool, TransportError> {
        Ok(false)
    }

    fn try_send(
        &mut self,
        header: &SegmentHeader,
        block: &[f32],
    ) -> Result<SendOutcome, TransportError> {
        let mut queue = lock(&self.0);
        if block.len() != queue.block_len {
            return Err(TransportError::Length { expected: queue.block_len, got: block.len() });
        }
        if !queue.attached {
            return Ok(SendOutcome::Detached);
        }
        let Some(mut segment) = queue.free.pop() else { return Ok(SendOutcome::Full) };
        segment.header = *header;
        segment.block.copy_from_slice(block);
        queue.full.push_back(segment);
        Ok(SendOutcome::Delivered)
    }
}

impl SegmentReceiver for Receiver {
    fn try_receive(&mut self, segment: &mut Segment) -> Result<bool, TransportError> {
        for turn in 0..self.queues.len() {
            let index = (self.next + turn) % self.queues.len();
            let mut queue = lock(&self.queues[index]);
            if let Some(mut taken) = queue.full.pop_front() {
                std::mem::swap(segment, &mut taken);
                // The caller's old buffer replaces the returned one in the free list.
                taken.block.resize(queue.block_len, 0.0);
                queue.free.push(taken);
                self.next = index + 1;
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn maintain(&mut self) -> Result<(), TransportError> {
        Ok(())
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        for queue in &self.queues {
            lock(queue).attached = false;
        }
    }
}

/// The learner's end of the parameter channel.
#[derive(Debug)]
pub struct Publisher(Arc<Mutex<ParameterSnapshot>>);

/// A worker's end of the parameter channel.
#[derive(Debug, Clone)]
pub struct Subscriber {
    newest: Arc<Mutex<ParameterSnapshot>>,
    architecture_hash: u64,
}

/// Creates a channel for snapshots of one architecture.
#[must_use]
pub fn parameter_channel(architecture_hash: u64) -> (Publisher, Subscriber) {
    let newest = Arc::new(Mutex::new(ParameterSnapshot::default()));
    (Publisher(newest.clone()), Subscriber { newest, architecture_hash })
}

impl ParameterPublisher for Publisher {
    fn publish(&mut self, snapshot: &ParameterSnapshot) -> Result<(), TransportError> {
        lock(&self.0).clone_from(snapshot);
        Ok(())
    }

    fn maintain(&mut self) -> Result<(), TransportError> {
        Ok(())
    }
}

impl ParameterSubscriber for Subscriber {
    fn newest(&mut self, snapshot: &mut ParameterSnapshot) -> Result<bool, TransportError> {
        let newest = lock(&self.newest);
        if newest.version <= snapshot.version {
            return Ok(false);
        }
        if newest.architecture_hash != self.architecture_hash {
            return Err(SnapshotError::Architecture {
                version: newest.version,
                expected: self.architecture_hash,
                got: newest.architecture_hash,
            }
            .into());
        }
        snapshot.clone_from(&newest);
        Ok(true)
    }

    fn epoch(&self) -> u64 {
        EPOCH
    }
}

/// The newest acknowledgements, and the number of publications so far.
#[derive(Debug)]
struct Acknowledged {
    marks: Vec<Watermark>,
    count: u64,
}

/// The learner's end of the acknowledgement channel.
#[derive(Debug)]
pub struct Acknowledger(Arc<Mutex<Acknowledged>>);

/// A worker's end of the acknowledgement channel.
#[derive(Debug, Clone)]
pub struct AcknowledgementReader {
    newest: Arc<Mutex<Acknowledged>>,
    taken: u64,
}

/// Creates a channel for the acknowledgements of `workers` workers.
#[must_use]
pub fn acknowledgement_channel(workers: usize) -> (Acknowledger, AcknowledgementReader) {
    let newest = Acknowledged { marks: vec![Watermark::default(); workers], count: 0 };
    let newest = Arc::new(Mutex::new(newest));
    (Acknowledger(newest.clone()), AcknowledgementReader { newest, taken: 0 })
}

impl AcknowledgementPublisher for Acknowledger {
    fn acknowledge(&mut self, marks: &[Watermark]) -> Result<(), TransportError> {
        let mut newest = lock(&self.0);
        let (expected, got) = (newest.marks.len(), marks.len());
        if got != expected {
            return Err(TransportError::Length { expected, got });
        }
        newest.marks.copy_from_slice(marks);
        newest.count += 1;
        Ok(())
    }

    fn maintain(&mut self) -> Result<(), TransportError> {
        Ok(())
    }
}

impl AcknowledgementSubscriber for AcknowledgementReader {
    fn newest(&mut self, acknowledgements: &mut Acknowledgements) -> Result<bool, TransportError> {
        let newest = lock(&self.newest);
        if newest.count == self.taken {
            return Ok(false);
        }
        self.taken = newest.count;
        acknowledgements.epoch = EPOCH;
        acknowledgements.marks.clear();
        acknowledgements.marks.extend_from_slice(&newest.marks);
        Ok(true)
    }
}
