//! Segments and snapshots between processes of one host, over iceoryx2.
//!
//! `domain` is the run's directory and `generation` the part of it that belongs to one learner,
//! `service`, `channel`, `cleaning` and `latest` tame the middleware, `segments` and `parameters`
//! implement the traits, `acknowledgements` is what `delivery` needs beside them. iceoryx2 is named
//! nowhere else.
//!
//! What holds when processes die:
//! - A worker never creates a service and never cleans up, so one killed in the middle blocks
//!   nobody. Its queued segments are still delivered; the learner's `maintain` frees its place.
//! - A dead learner's queues are lost: `Delivered` promises no more than the queue. Workers see
//!   `Full` or `Detached` until the next learner serves the same domain, then follow it. What must
//!   not be lost is kept by `delivery` until it is acknowledged.
//! - A new learner inherits nothing from the one before: whatever that left half-made is removed.

mod acknowledgements;
mod channel;
mod cleaning;
mod domain;
mod generation;
mod latest;
mod parameters;
mod segments;
mod service;

use std::path::Path;
use std::sync::Arc;

pub use acknowledgements::{AcknowledgementReader, Acknowledger};
pub use domain::{Domain, DomainError, Leftover, abandoned, remove_abandoned};
use generation::Generation;
use iceoryx2::service::header::publish_subscribe::Header;
pub use parameters::{Publisher, Subscriber};
pub use segments::{Receiver, Sender};

use super::{TransportError, WorkerTransport};
use crate::config::ExperimentConfig;
use crate::policy::Policy;
use crate::segment::SegmentLayout;

/// Version of what the processes of a run say to each other; others are refused.
const PROTOCOL: u32 = 2;
/// Locked by the learner as long as it lives.
const LEARNER_LOCK: &str = "learner.lock";
/// Queues, registries and descriptions of one service, besides its chunks [bytes]. Measured: see
/// the test `the_space_asked_for_covers_what_is_used`.
const SERVICE_BYTES: usize = 64 * 1024;
/// The same for each segment of a queue's capacity [bytes].
const QUEUE_ENTRY_BYTES: usize = 64;

/// What learner and workers of a run agree on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Plan {
    /// Another run's workers are refused.
    pub run_id: u64,
    /// Another architecture's workers are refused.
    pub architecture_hash: u64,
    /// Sizes of a segment.
    pub layout: SegmentLayout,
    /// Worker slots, each with a queue of its own.
    pub worker_count: usize,
    /// Segments that fit into one worker's queue.
    pub queue_segments: usize,
    /// Length of a snapshot's values.
    pub parameters_len: usize,
}

impl Plan {
    /// The plan of a run whose policy is known.
    #[must_use]
    pub fn new(config: &ExperimentConfig, run_id: u64, policy: &Policy) -> Self {
        Self {
            run_id,
            architecture_hash: policy.architecture_hash(),
            layout: policy.layout(),
            worker_count: config.places(),
            queue_segments: config.actors.queue_segments,
            parameters_len: policy.parameters_len(),
        }
    }

    fn identity(&self) -> Vec<(&'static str, String)> {
        vec![
            ("protocol", PROTOCOL.to_string()),
            ("run_id", format!("{:#018x}", self.run_id)),
            ("architecture_hash", format!("{:#018x}", self.architecture_hash)),
        ]
    }

    /// Shared memory that the run may use at most \[bytes\].
    #[must_use]
    pub fn required_bytes(&self) -> u64 {
        let Self { worker_count, queue_segments, layout, parameters_len, .. } = *self;
        required_bytes(worker_count, queue_segments, layout, parameters_len)
    }
}

/// Shared memory that a run may use at most \[bytes\].
#[must_use]
pub fn required_bytes(
    worker_count: usize,
    queue_segments: usize,
    layout: SegmentLayout,
    parameters_len: usize,
) -> u64 {
    let chunk = |header: usize, len: usize| {
        len.saturating_mul(size_of::<f32>()).saturating_add(size_of::<Header>() + header)
    };
    let segment = chunk(size_of::<segments::WireHeader>(), layout.block_len());
    let queue = segments::chunk_count(queue_segments)
        .saturating_mul(segment.saturating_add(QUEUE_ENTRY_BYTES))
        .saturating_add(SERVICE_BYTES);
    let snapshots = chunk(size_of::<parameters::WireHeader>(), parameters_len)
        .saturating_mul(latest::chunk_count(worker_count));
    // Two numbers a worker, each as long as two f32.
    let marks = chunk(0, acknowledgements::sample_len(worker_count).saturating_mul(2))
        .saturating_mul(latest::chunk_count(worker_count));
    // Each worker has a connection on the channels for snapshots and acknowledgements too.
    let services = worker_count.saturating_add(1).saturating_mul(2 * SERVICE_BYTES);
    let bytes = worker_count.saturating_mul(queue).saturating_add(snapshots).saturating_add(marks);
    u64::try_from(bytes.saturating_add(services)).unwrap_or(u64::MAX)
}

/// What the learner holds. Its parts may live on different threads; no worker can attach any more
/// once one of them is dropped.
#[derive(Debug)]
pub struct LearnerEnd {
    /// Takes segments from all workers.
    pub segments: Receiver,
    /// Publishes snapshots to all workers.
    pub parameters: Publisher,
    /// Tells all workers what has arrived for good.
    pub acknowledgements: Acknowledger,
}

/// Names this transport's types.
#[derive(Debug)]
pub struct SharedMemory;

impl WorkerTransport for SharedMemory {
    type Segments = Sender;
    type Parameters = Subscriber;
    type Acknowledgements = AcknowledgementReader;
}

/// What a worker holds.
pub type WorkerEnd = super::WorkerEnd<SharedMemory>;

/// Makes this process the run's learner and creates all services. Workers of a learner before it
/// follow by themselves.
///
/// # Errors
/// `Domain` if the directory is not a domain, another learner lives or space is short,
/// `Middleware` for the rest. Whatever was half-made is removed by the next call.
pub fn serve(domain: &Path, plan: &Plan) -> Result<LearnerEnd, TransportError> {
    let domain = Domain::open(domain)?;
    let learner = Arc::new(domain.lock(LEARNER_LOCK)?);
    let generation = Generation::begin(&domain)?;
    if generation.is_first() {
        // Later, workers still hold the generation before, and give it back one by one.
        domain.check_space(plan.required_bytes())?;
    }
    let node = service::join(&generation.root)?;
    let parameters = Publisher::serve(&domain, &node, plan, learner.clone())?;
    let acknowledgements = Acknowledger::serve(&node, plan, generation.number, learner.clone())?;
    let segments = Receiver::serve(node, plan, learner)?;
    generation.announce()?;
    Ok(LearnerEnd { segments, parameters, acknowledgements })
}

/// Attaches this process to the run as worker `worker_index`. Opens, never creates.
///
/// # Errors
/// `Taken` if a worker of that index lives, or died and the learner's `maintain` has not freed its
/// place yet: attach again a little later. `Incompatible` if the learner follows another plan.
/// `Domain` if the directory is not a domain. `Middleware` if no learner has served it yet, and
/// for the rest.
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

/// Attaches this process to the queue of one worker only, on whose behalf it sends.
///
/// # Errors
/// As [`attach`].
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
/// As [`attach`].
pub fn hear(domain: &Path, plan: &Plan) -> Result<AcknowledgementReader, TransportError> {
    AcknowledgementReader::attach(&Domain::open(domain)?, plan)
}

/// Attaches this process as a reader of snapshots only, such as the evaluator.
///
/// # Errors
/// As [`attach`].
pub fn subscribe(domain: &Path, plan: &Plan) -> Result<Subscriber, TransportError> {
    Subscriber::attach(&Domain::open(domain)?, plan)
}
