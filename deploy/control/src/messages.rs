//! What supervisor and roles say to each other: one JSON object a line, on the child's standard
//! input and output. A child's standard error is its log file.
//!
//! End of input means that the supervisor is gone: the child ends itself (the learner after a
//! checkpoint), so no SIGKILL of the supervisor leaves an orphan.

use std::fmt::{self, Display, Formatter};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// What a terminal or a service manager sends to the whole process group. Only the supervisor
/// listens; roles ignore it.
pub const GROUP_SIGNALS: [i32; 3] = [libc::SIGINT, libc::SIGTERM, libc::SIGHUP];

/// Where a run's supervisor takes in workers that join, below its private directory.
pub const JOIN_SOCKET: &str = "join.sock";
/// Version of what a supervisor and a worker that joins say to each other. Children are of the
/// same build and need none.
const CONTROL_VERSION: u32 = 1;

/// Which program speaks; the supervisor says so first.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Greeting {
    /// Of the program.
    pub version: String,
    /// Of this protocol.
    pub control: u32,
}

impl Greeting {
    /// This program.
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

/// From a worker that asks to join.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JoinRequest {
    /// Which program it is.
    pub speaks: Greeting,
}

/// From the supervisor to a worker that has asked to join.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum JoinAnswer {
    /// It may.
    Welcome(Welcome),
    /// It may not.
    Refused {
        /// Why, and what can be done.
        reason: String,
    },
}

/// What a worker that joins is from now on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Welcome {
    /// Which of the run's workers.
    pub index: u32,
    /// Which start of it.
    pub incarnation: u32,
    /// The run's Python virtual environment.
    pub venv: Option<PathBuf>,
    /// How many workers there are, with it.
    pub workers: usize,
}
