//! Segments and snapshots between processes of one host, over iceoryx2.
//!
//! `domain` is the run's directory, and `generation` the part of it that belongs to one learner.
//! `service`, `channel`, `cleaning` and `latest` wrap the middleware. `segments` and `parameters`
//! implement the traits; `acknowledgements` is the third channel, for `delivery`. No other module
//! uses iceoryx2.
//!
//! Guarantees when processes die:
//! - A worker never creates a service and never cleans up, so its death at any point blocks no
//!   other process. Its queued segments are still delivered; the learner's `maintain` frees its
//!   slot.
//! - A dead learner's queues are lost: `Delivered` only means that the segment is in the queue.
//!   Workers get `Full` or `Detached` until the next learner serves the same domain, and then
//!   reconnect to it. `delivery` keeps unacknowledged segments until then.
//! - A new learner inherits nothing from its predecessor: it removes all incomplete files.

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

/// Version of the protocol between the processes of a run; other versions are rejected.
const PROTOCOL: u32 = 2;
/// The learner holds this lock as long as it lives.
const LEARNER_LOCK: &str = "learner.lock";
/// Queues, registries and descriptions of one service, without its chunks [bytes]. Measured: see
/// the test `the_space_asked_for_covers_what_is_used`.
const SERVICE_BYTES: usize = 64 * 1024;
/// The same per segment of a queue's capacity [bytes].
const QUEUE_ENTRY_BYTES: usize = 64;

/// Parameters that must be equal in the learner and the workers of a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Plan {
    /// Run; workers of another run are rejected.
    pub run_id: u64,
    /// Hash of the architecture; workers with another one are rejected.
    pub architecture_hash: u64,
    /// Sizes of a segment.
    pub layout: SegmentLayout,
    /// Number of worker slots, each with its own queue.
    pub worker_count: usize,
    /// Capacity of each worker's queue in segments.
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

    /// Maximum shared memory of the run \[bytes\].
    #[must_use]
    pub fn required_bytes(&self) -> u64 {
        let Self { worker_count, queue_segments, layout, parameters_len, .. } = *self;
        required_bytes(worker_count, queue_segments, layout, parameters_len)
    }
}

/// Maximum shared memory of a run \[bytes\].
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
    // Two numbers per worker, each as large as two f32.
    let marks = chunk(0, acknowledgements::sample_len(worker_count).saturating_mul(2))
        .saturating_mul(latest::chunk_count(worker_count));
    // Each worker also has a connection on the channels for snapshots and acknowledgements.
    let services = worker_count.saturating_add(1).saturating_mul(2 * SERVICE_BYTES);
    let bytes = worker_count.saturating_mul(queue).saturating_add(snapshots).saturating_add(marks);
    u64::try_from(bytes.saturating_add(services)).unwrap_or(u64::MAX)
}

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

/// Makes this process the run's learner and creates all services. Workers of a previous learner
/// reconnect on their own.
///
/// # Errors
/// `Domain` if the directory is not a domain, another learner lives or space is short, `Middleware`
/// for other errors. The next call removes incomplete files.
pub fn serve(domain: &Path, plan: &Plan) -> Result<LearnerEnd, TransportError> {
    let domain = Domain::open(domain)?;
    let learner = Arc::new(domain.lock(LEARNER_LOCK)?);
    let generation = Generation::begin(&domain)?;
    if generation.is_first() {
        // Later, workers still hold the previous generation's memory and release it one by one.
        domain.check_space(plan.required_bytes())?;
    }
    let node = service::join(&generation.root)?;
    let parameters = Publisher::serve(&domain, &node, plan, learner.clone())?;
    let acknowledgements = Acknowledger::serve(&node, plan, generation.number, learner.clone())?;
    let segments = Receiver::serve(node, plan, learner)?;
    generation.announce()?;
    Ok(LearnerEnd { segments, parameters, acknowledgements })
}

/// Attaches this process to the run as worker `worker_index`. It opens services and never creates
/// one.
///
/// # Errors
/// `Taken` if a worker with this index lives, or died and the learner's `maintain` has not freed
/// its slot yet: retry a little later. `Incompatible` if the learner has another plan. `Domain` if
/// the directory is not a domain. `Middleware` if no learner has served it yet, and for other
/// errors.
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

/// Attaches this process only to the queue of one worker, on whose behalf it sends.
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
