//! Errors of a domain.

use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

/// Maximum length of a generation's path with iceoryx2's prefix [bytes]. iceoryx2 appends up to 38
/// bytes for Unix sockets, whose paths are limited to 108.
pub(super) const ROOT_BYTES_MAX: usize = 70;
pub(super) const TOKEN_BYTES_MAX: usize = 32;

/// Why a domain could not be created, opened or removed.
#[derive(Debug, Error)]
pub enum DomainError {
    /// The operating system returned an error.
    #[error("{operation} {path}: {cause}")]
    Io {
        /// The attempted operation.
        operation: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// The error.
        cause: io::Error,
    },
    /// The directory is not private to this user, or is not a domain.
    #[error("{path}: expected {expected}, got {got}")]
    Untrusted {
        /// The directory.
        path: PathBuf,
        /// Required properties.
        expected: &'static str,
        /// Actual properties.
        got: String,
    },
    /// The path leaves too little space for the names of sockets.
    #[error(
        "shared-memory path {path} has {got} bytes including suffixes, the maximum is \
         {ROOT_BYTES_MAX}: choose a shorter directory or token"
    )]
    TooLong {
        /// The directory.
        path: PathBuf,
        /// Length of the path with the generation's directory and iceoryx2's prefix \[bytes\].
        got: usize,
    },
    /// The token is empty, too long or contains invalid characters.
    #[error("token {got:?}: expected 1 to {TOKEN_BYTES_MAX} characters a-z, A-Z, 0-9, - or _")]
    Token {
        /// The token.
        got: String,
    },
    /// Another process holds a lock.
    #[error("{path} is locked by a live process")]
    Locked {
        /// The locked file or directory.
        path: PathBuf,
    },
    /// Too little shared memory is free. Processes would later be killed by SIGBUS.
    #[error(
        "{path}: {needed} bytes of shared memory needed, {available} available: use fewer \
         workers or shorter queues, or enlarge it (Docker: --shm-size)"
    )]
    Space {
        /// The directory.
        path: PathBuf,
        /// Required shared memory \[bytes\].
        needed: u64,
        /// Available shared memory \[bytes\].
        available: u64,
    },
}

/// Wraps an error of the operating system.
pub(super) fn failed(
    operation: &'static str,
    path: &Path,
) -> impl FnOnce(io::Error) -> DomainError {
    let path = path.to_owned();
    move |cause| DomainError::Io { operation, path, cause }
}
