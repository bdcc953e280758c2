//! Errors of every transport.

use thiserror::Error;

use super::shared_memory::DomainError;
use crate::parameters::SnapshotError;

/// Why the transport failed.
#[derive(Debug, Error)]
pub enum TransportError {
    /// The middleware returned an error.
    #[error("{operation} on {name}: {cause}")]
    Middleware {
        /// The attempted operation.
        operation: &'static str,
        /// The service or directory.
        name: String,
        /// The middleware's error message.
        cause: String,
    },
    /// The peer has another version or another configuration.
    #[error("{name}: peers disagree, {cause}; start both from the same build and configuration")]
    Incompatible {
        /// The service.
        name: String,
        /// The difference.
        cause: String,
    },
    /// The slot belongs to a live process, or to a dead one that has not been cleaned up yet.
    #[error("{name} is taken ({cause}): try again when the process that holds it has ended")]
    Taken {
        /// The service.
        name: String,
        /// The middleware's error message.
        cause: String,
    },
    /// A segment or snapshot of the wrong length was offered or received.
    #[error("{got} numbers, this channel carries {expected}")]
    Length {
        /// Length that the channel was created for.
        expected: usize,
        /// Length that was offered or received.
        got: usize,
    },
    /// The run's shared-memory directory is unusable.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// A damaged snapshot, or one of another architecture.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
}
