//! Computes the shared memory that a run needs.

use iceoryx2::service::header::publish_subscribe::Header;

use super::plan::Plan;
use super::{acknowledgements, latest, parameters, segments};
use crate::segment::SegmentLayout;

/// Overhead of one service: queues, registries and descriptions, without its chunks [bytes].
/// The test `required_space_covers_the_measured_usage` checks it.
const SERVICE_BYTES: usize = 64 * 1024;
/// Additional overhead per segment of a queue's capacity [bytes].
const QUEUE_ENTRY_BYTES: usize = 64;

impl Plan {
    /// Returns the maximum shared memory of the run \[bytes\].
    #[must_use]
    pub fn required_bytes(&self) -> u64 {
        let Self { worker_count, queue_segments, layout, parameters_len, .. } = *self;
        required_bytes(worker_count, queue_segments, layout, parameters_len)
    }
}

/// Returns the maximum shared memory of a run \[bytes\].
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
    // Each worker also has a connection to the channels for snapshots and acknowledgements.
    let services = worker_count.saturating_add(1).saturating_mul(2 * SERVICE_BYTES);
    let bytes = worker_count.saturating_mul(queue).saturating_add(snapshots).saturating_add(marks);
    u64::try_from(bytes.saturating_add(services)).unwrap_or(u64::MAX)
}
