//! Stages 4 and 7 of 8: segments and snapshots between processes of one host, over iceoryx2.
//!
//! `domain` is the run's directory, and `generation` the part of it that belongs to one learner.
//! `plan` contains the parameters that all processes share, and `space` computes the memory that
//! they need. `service`, `channel`, `cleaning` and `latest` wrap the middleware. `segments`,
//! `parameters` and `acknowledgements` are the three channels. No other module uses iceoryx2.
//!
//! Guarantees when processes die:
//! - A worker never creates a service and never cleans up, so its death at any point does not block
//!   other processes. Its queued segments are still delivered. The learner's `maintain` frees its
//!   slot.
//! - A dead learner's queues are lost: `Delivered` only means that the segment is in the queue.
//!   Workers get `Full` or `Detached` until the next learner serves the same domain, and then
//!   reconnect. Meanwhile `delivery` keeps unacknowledged segments.
//! - A new learner reuses nothing from its predecessor and removes the predecessor's files.

mod acknowledgements;
mod channel;
mod cleaning;
mod domain;
mod generation;
mod latest;
mod parameters;
mod plan;
mod segments;
mod service;
mod space;

use std::path::Path;
use std::sync::Arc;

pub use acknowledgements::{AcknowledgementReader, Acknowledger};
use domain::LEARNER_LOCK;
pub use domain::{Domain, DomainError, Leftover, abandoned, remove_abandoned};
use generation::Generation;
pub use parameters::{Publisher, Subscriber};
pub use plan::Plan;
pub use segments::{Receiver, Sender};
pub use space::required_bytes;

use super::{TransportError, WorkerTransport};

/// The learner's ends of all channels.
///
/// The fields may be moved to different threads. Once one of them is dropped, no worker can attach.
#[derive(Debug)]
pub struct LearnerEnd {
    /// Receives segments from all workers.
    pub segments: Receiver,
    /// Publishes snapshots to all workers.
    pub parameters: Publisher,
    /// Publishes acknowledgements to all workers.
    pub acknowledgements: Acknowledger,
}

/// The types of this transport.
#[derive(Debug)]
pub struct SharedMemory;

impl WorkerTransport for SharedMemory {
    type Segments = Sender;
    type Parameters = Subscriber;
    type Acknowledgements = AcknowledgementReader;
}

/// A worker's ends of the transport.
pub type WorkerEnd = super::WorkerEnd<SharedMemory>;

/// Makes this process the run's learner and creates all services. Workers of a previous learner
/// reconnect on their own.
///
/// # Errors
/// `Domain` if the directory is not a domain, another learner is alive or too little space is free;
/// `Middleware` for other errors. The next call removes incomplete files.
pub fn serve(domain: &Path, plan: &Plan) -> Result<LearnerEnd, TransportError> {
    let domain = Domain::open(domain)?;
    let learner = Arc::new(domain.lock(LEARNER_LOCK)?);
    let generation = Generation::begin(&domain)?;
    if generation.is_first() {
        // Later generations skip this check, because workers still use the previous generation's
        // memory for a while.
        domain.check_space(plan.required_bytes())?;
    }
    let node = service::join(&generation.root)?;
    let parameters = Publisher::serve(&domain, &node, plan, learner.clone())?;
    let acknowledgements = Acknowledger::serve(&node, plan, generation.number, learner.clone())?;
    let segments = Receiver::serve(node, plan, learner)?;
    generation.announce()?;
    Ok(LearnerEnd { segments, parameters, acknowledgements })
}

/// Attaches this process to the run as worker `worker_index`. Opens services and never creates one.
///
/// # Errors
/// - `Taken` if a worker with this index is alive, or if it died and the learner's `maintain` has
///   not freed its slot yet. Retry later.
/// - `Incompatible` if the learner has another plan.
/// - `Domain` if the directory is not a domain.
/// - `Middleware` if no learner has served it yet, and for other errors.
pub fn attach(
    domain: &Path,
    plan: &Plan,
    worker_index: usize,
) -> Result<WorkerEnd, TransportError> {
    let domain = Domain::open(domain)?;
    let segments = Sender::attach(&domain, plan, worker_index)?;
    let parameters = Subscriber::attach(&domain, plan)?;
    let acknowledgements = AcknowledgementReader::attach(&domain, plan)?;
    Ok(WorkerEnd { segments, parameters, acknowledgements })
}

/// Attaches this process only to the queue of one worker, to send on its behalf.
///
/// # Errors
/// The errors of [`attach`].
pub fn attach_queue(
    domain: &Path,
    plan: &Plan,
    worker_index: usize,
) -> Result<Sender, TransportError> {
    Sender::attach(&Domain::open(domain)?, plan, worker_index)
}

/// Attaches this process as a reader of acknowledgements only.
///
/// # Errors
/// The errors of [`attach`].
pub fn hear(domain: &Path, plan: &Plan) -> Result<AcknowledgementReader, TransportError> {
    AcknowledgementReader::attach(&Domain::open(domain)?, plan)
}

/// Attaches this process as a reader of snapshots only.
///
/// # Errors
/// The errors of [`attach`].
pub fn subscribe(domain: &Path, plan: &Plan) -> Result<Subscriber, TransportError> {
    Subscriber::attach(&Domain::open(domain)?, plan)
}
