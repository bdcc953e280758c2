//! Errors of all transports.

use thiserror::Error;

use super::shared_memory::DomainError;
use crate::parameters::SnapshotError;

/// Why the transport failed.
#[derive(Debug, Error)]
pub enum TransportError {
    /// The middleware returned an error.
    #[error("{operation} {name}: {cause}")]
    Middleware {
        /// The attempted operation.
        operation: &'static str,
        /// The service or directory.
        name: String,
        /// The middleware's error message.
        cause: String,
    },
    /// The peer has another version or another configuration.
    #[error("{name}: peers differ ({cause}); start both from the same build and configuration")]
    Incompatible {
        /// The service.
        name: String,
        /// The difference.
        cause: String,
    },
    /// A live process occupies the slot, or a dead one whose resources have not been freed yet.
    #[error("{name} is in use ({cause}): retry after the process that uses it has ended")]
    Taken {
        /// The service.
        name: String,
        /// The middleware's error message.
        cause: String,
    },
    /// A segment or snapshot of the wrong length was offered or received.
    #[error("got {got} numbers, this channel transfers {expected}")]
    Length {
        /// Expected length.
        expected: usize,
        /// Actual length.
        got: usize,
    },
    /// The run's shared-memory directory is unusable.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// A corrupted snapshot, or one of another architecture.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
}
