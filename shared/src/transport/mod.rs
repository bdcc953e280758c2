//! Stages 4 and 7 of 8: segments from workers to the learner, policy snapshots back.
//!
//! Two implementations of the same six traits: `in_process` (one-process runs and tests) and
//! `shared_memory` (iceoryx2, between processes). No call here waits: a full queue is reported,
//! and who waits, how long and on whom to blame it is the caller's business. What is kept until it
//! has arrived for good, and what has arrived before, is `delivery`'s.

pub mod delivery;
pub mod in_process;
pub mod shared_memory;

use delivery::{Acknowledgements, Mark};
use thiserror::Error;

use crate::parameters::{ParameterSnapshot, SnapshotError};
use crate::segment::{Segment, SegmentHeader};

/// What became of a segment that was offered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SendOutcome {
    /// It lies in the learner's queue.
    Delivered,
    /// The queue is full: offer it again later.
    Full,
    /// No learner is attached (not yet, or no longer): offer it again later.
    Detached,
}

/// Why the transport failed.
#[derive(Debug, Error)]
pub enum TransportError {
    /// The middleware refused an operation.
    #[error("{operation} on {name}: {cause}")]
    Middleware {
        /// What was attempted.
        operation: &'static str,
        /// Service or directory.
        name: String,
        /// The middleware's own words.
        cause: String,
    },
    /// The peer was built from another version or runs another configuration.
    #[error("{name}: peers disagree, {cause}; start both from the same build and configuration")]
    Incompatible {
        /// Service.
        name: String,
        /// What differs.
        cause: String,
    },
    /// The place belongs to a live process, or to one that is just being cleaned up after.
    #[error("{name} is taken ({cause}): try again when the process that holds it has ended")]
    Taken {
        /// Service.
        name: String,
        /// The middleware's own words.
        cause: String,
    },
    /// A segment or a snapshot of the wrong length was offered, or received.
    #[error("{got} numbers, this channel carries {expected}")]
    Length {
        /// Length the channel was made for.
        expected: usize,
        /// Length offered or received.
        got: usize,
    },
    /// The run's shared-memory directory is not usable.
    #[error(transparent)]
    Domain(#[from] shared_memory::DomainError),
    /// A damaged or foreign snapshot.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
}

/// The worker's end of its segment queue.
pub trait SegmentSender {
    /// Connects anew if there is another learner or the connection broke; to be called before each
    /// round of offers. True once for each new connection: what was delivered through the one
    /// before and is not acknowledged may be lost.
    ///
    /// # Errors
    /// `Incompatible` if the learner follows another plan, others when they persist.
    fn renew(&mut self) -> Result<bool, TransportError>;

    /// Offers one segment without waiting. Only `Delivered` means that it was taken.
    ///
    /// # Errors
    /// `Length` if the block does not fit, `Middleware` if the queue is broken.
    fn try_send(
        &mut self,
        header: &SegmentHeader,
        block: &[f32],
    ) -> Result<SendOutcome, TransportError>;
}

/// The learner's end of all segment queues, taken from in turn so that none starves.
pub trait SegmentReceiver {
    /// Copies the next segment into `segment`; `false` if every queue is empty.
    ///
    /// # Errors
    /// `Middleware` if a queue is broken.
    fn try_receive(&mut self, segment: &mut Segment) -> Result<bool, TransportError>;

    /// Frees what dead workers left behind; to be called a few times a second.
    ///
    /// # Errors
    /// `Middleware` if the cleaning itself failed.
    fn maintain(&mut self) -> Result<(), TransportError>;
}

/// The learner's end of the parameter channel: the newest snapshot replaces the one before.
pub trait ParameterPublisher {
    /// Publishes a snapshot to all workers, and to those that join later.
    ///
    /// # Errors
    /// `Length` if it does not fit, `Middleware` if publishing failed.
    fn publish(&mut self, snapshot: &ParameterSnapshot) -> Result<(), TransportError>;

    /// Hands the newest snapshot to workers that have joined since; to be called a few times a
    /// second.
    ///
    /// # Errors
    /// `Middleware` if the channel is broken.
    fn maintain(&mut self) -> Result<(), TransportError>;
}

/// A worker's end of the parameter channel.
pub trait ParameterSubscriber {
    /// Copies the newest snapshot into `snapshot` if there is one newer than the last taken.
    ///
    /// # Errors
    /// `Snapshot` if it is damaged or foreign (then `snapshot` is unchanged), `Middleware` if the
    /// channel is broken.
    fn newest(&mut self, snapshot: &mut ParameterSnapshot) -> Result<bool, TransportError>;

    /// Number of the learner that this channel is connected to, counted over a session.
    fn epoch(&self) -> u64;
}

/// The learner's end of the acknowledgement channel. Acknowledgements are cumulative: the newest
/// replace the ones before.
pub trait AcknowledgementPublisher {
    /// Tells every worker how far its segments have arrived; to be called a hundred times a second.
    ///
    /// # Errors
    /// `Length` if there is not one mark a worker, `Middleware` if publishing failed.
    fn acknowledge(&mut self, marks: &[Mark]) -> Result<(), TransportError>;

    /// Lets workers in that have joined since; to be called a few times a second.
    ///
    /// # Errors
    /// `Middleware` if the channel is broken.
    fn maintain(&mut self) -> Result<(), TransportError>;
}

/// A worker's end of the acknowledgement channel.
pub trait AcknowledgementSubscriber {
    /// Copies the newest acknowledgements into `acknowledgements` if they have not been taken yet.
    ///
    /// # Errors
    /// `Length` if there is not one mark a worker, `Middleware` if the channel is broken.
    fn newest(&mut self, acknowledgements: &mut Acknowledgements) -> Result<bool, TransportError>;
}

/// The types of a worker's ends in one implementation of the transport.
pub trait WorkerTransport {
    /// Offers segments to the learner.
    type Segments: SegmentSender;
    /// Takes the learner's newest snapshot.
    type Parameters: ParameterSubscriber;
    /// Takes what the learner says has arrived for good.
    type Acknowledgements: AcknowledgementSubscriber;
}

/// A worker's three ends of the transport.
#[derive(Debug)]
pub struct WorkerEnd<T: WorkerTransport> {
    /// Offers segments to the learner.
    pub segments: T::Segments,
    /// Takes the learner's newest snapshot.
    pub parameters: T::Parameters,
    /// Takes what the learner says has arrived for good.
    pub acknowledgements: T::Acknowledgements,
}
