//! Messages with which a worker joins a run. The messages of `dmprl_shared::supervision` follow.
//!
//! All messages are JSON objects, one per line. A worker that joins uses a socket; a child uses its
//! standard input and output, and its standard error is its log file. End of input means that the
//! supervisor is gone. The process then exits (the learner after a checkpoint), so a supervisor
//! killed by SIGKILL leaves no orphans.

use std::fmt::{self, Display, Formatter};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// Signals that a terminal or service manager sends to the whole process group. Only the supervisor
/// handles them; roles ignore them.
pub const GROUP_SIGNALS: [i32; 3] = [libc::SIGINT, libc::SIGTERM, libc::SIGHUP];

/// Name of the socket on which a supervisor accepts workers that join, in its private directory.
pub const JOIN_SOCKET: &str = "join.sock";
/// Version of the protocol between a supervisor and a worker that joins. Children are of the same
/// build and need no version.
const CONTROL_VERSION: u32 = 1;

/// Version of a program. Each side sends its own, the supervisor first.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Greeting {
    /// Version of `dmprl`.
    pub version: String,
    /// Version of this protocol.
    pub control: u32,
}

impl Greeting {
    /// Returns the version of this program.
    #[must_use]
    pub fn this() -> Self {
        Self { version: env!("CARGO_PKG_VERSION").to_owned(), control: CONTROL_VERSION }
    }
}

impl Display for Greeting {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        write!(formatter, "dmprl {} (protocol {})", self.version, self.control)
    }
}

/// Request of a worker to join.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JoinRequest {
    /// Version of the worker's program.
    pub speaks: Greeting,
}

/// The supervisor's answer to a [`JoinRequest`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum JoinAnswer {
    /// The worker may join.
    Welcome(Welcome),
    /// The worker may not join.
    Refused {
        /// The reason, with advice.
        reason: String,
    },
}

/// Settings of a worker that joins.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Welcome {
    /// Index of the worker in the run.
    pub index: u32,
    /// Number of this start of the worker, unique for its index in the run.
    pub incarnation: u32,
    /// The run's Python virtual environment.
    pub venv: Option<PathBuf>,
    /// Number of workers, including this one.
    pub workers: usize,
}
