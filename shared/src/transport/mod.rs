//! Stages 4 and 7 of 8: transfers segments from workers to the learner and policy snapshots back.
//!
//! Six traits have two implementations each: `in_process` (one-process runs and tests) and
//! `shared_memory` (iceoryx2, between processes). No call blocks: if a queue is full, the call says
//! so, and the caller decides how long to wait. `delivery` keeps segments until they are
//! acknowledged, and drops duplicates.

pub mod delivery;
mod error;
pub mod in_process;
pub mod shared_memory;

use delivery::{Acknowledgements, Watermark};
pub use error::TransportError;

use crate::parameters::ParameterSnapshot;
use crate::segment::{Segment, SegmentHeader};

/// Result of offering a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SendOutcome {
    /// The segment is in the learner's queue.
    Delivered,
    /// The queue is full. Retry later.
    Full,
    /// No learner is attached at the moment. Retry later.
    Detached,
}

/// The worker's end of its segment queue.
pub trait SegmentSender {
    /// Reconnects if there is a new learner or the connection broke. Call it before each round of
    /// offers.
    ///
    /// Returns true once for each new connection. Unacknowledged segments that were sent through
    /// the previous connection may be lost.
    ///
    /// # Errors
    /// `Incompatible` if the learner has another plan. Other errors only if they persist.
    fn renew(&mut self) -> Result<bool, TransportError>;

    /// Offers one segment without blocking. The queue has accepted it only if the result is
    /// `Delivered`.
    ///
    /// # Errors
    /// `Length` if the block has the wrong length, `Middleware` if the queue is broken.
    fn try_send(
        &mut self,
        header: &SegmentHeader,
        block: &[f32],
    ) -> Result<SendOutcome, TransportError>;
}

/// The learner's end of all segment queues. It serves the queues in turn, so that no worker
/// starves.
pub trait SegmentReceiver {
    /// Copies the next segment into `segment`. Returns false if every queue is empty.
    ///
    /// # Errors
    /// `Middleware` if a queue is broken.
    fn try_receive(&mut self, segment: &mut Segment) -> Result<bool, TransportError>;

    /// Frees the resources of dead workers. Call it a few times per second.
    ///
    /// # Errors
    /// `Middleware` if the cleanup failed.
    fn maintain(&mut self) -> Result<(), TransportError>;
}

/// The learner's end of the parameter channel. Each snapshot replaces the previous one.
pub trait ParameterPublisher {
    /// Publishes a snapshot to all workers, including those that join later.
    ///
    /// # Errors
    /// `Length` if its length is wrong, `Middleware` if publishing failed.
    fn publish(&mut self, snapshot: &ParameterSnapshot) -> Result<(), TransportError>;

    /// Sends the newest snapshot to workers that have joined since. Call it a few times per second.
    ///
    /// # Errors
    /// `Middleware` if the channel is broken.
    fn maintain(&mut self) -> Result<(), TransportError>;
}

/// A worker's end of the parameter channel.
pub trait ParameterSubscriber {
    /// Copies the newest snapshot into `snapshot` if it is newer than the last one. Returns whether
    /// it did.
    ///
    /// # Errors
    /// `Snapshot` if it is damaged or of another architecture (then `snapshot` is unchanged),
    /// `Middleware` if the channel is broken.
    fn newest(&mut self, snapshot: &mut ParameterSnapshot) -> Result<bool, TransportError>;

    /// Returns the number of the learner that this channel is connected to. Each new learner of a
    /// session has a higher number.
    fn epoch(&self) -> u64;
}

/// The learner's end of the acknowledgement channel. Acknowledgements are cumulative, so each one
/// replaces all earlier ones.
pub trait AcknowledgementPublisher {
    /// Sends the newest mark of every worker. Call it about a hundred times per second.
    ///
    /// # Errors
    /// `Length` if there is not one mark per worker, `Middleware` if publishing failed.
    fn acknowledge(&mut self, marks: &[Watermark]) -> Result<(), TransportError>;

    /// Sends the newest acknowledgements to workers that have joined since. Call it a few times per
    /// second.
    ///
    /// # Errors
    /// `Middleware` if the channel is broken.
    fn maintain(&mut self) -> Result<(), TransportError>;
}

/// A worker's end of the acknowledgement channel.
pub trait AcknowledgementSubscriber {
    /// Copies the newest acknowledgements into `acknowledgements` unless a previous call already
    /// did. Returns whether it copied them.
    ///
    /// # Errors
    /// `Length` if there is not one mark per worker, `Middleware` if the channel is broken.
    fn newest(&mut self, acknowledgements: &mut Acknowledgements) -> Result<bool, TransportError>;
}

/// The types of a worker's ends of the channels, in one implementation of the transport.
pub trait WorkerTransport {
    /// Offers segments to the learner.
    type Segments: SegmentSender;
    /// Receives the learner's newest snapshot.
    type Parameters: ParameterSubscriber;
    /// Receives the learner's acknowledgements.
    type Acknowledgements: AcknowledgementSubscriber;
}

/// A worker's ends of the three channels.
#[derive(Debug)]
pub struct WorkerEnd<T: WorkerTransport> {
    /// Offers segments to the learner.
    pub segments: T::Segments,
    /// Receives the learner's newest snapshot.
    pub parameters: T::Parameters,
    /// Receives the learner's acknowledgements.
    pub acknowledgements: T::Acknowledgements,
}
