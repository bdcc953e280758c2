//! How a link is made, and how urgent its messages are.

use std::fmt::{Display, Formatter};

/// How an end of a link makes its connection.
#[derive(Debug, Clone, Copy)]
pub enum LinkMode<'a> {
    /// The learner's host, which listens on these endpoints.
    Listen(&'a [String]),
    /// Another host, which connects to this endpoint.
    Connect(&'a str),
}

impl LinkMode<'_> {
    /// True if any endpoint is a `tls/` endpoint.
    #[must_use]
    pub fn has_tls(&self) -> bool {
        match self {
            Self::Listen(at) => at.iter().any(|endpoint| endpoint.starts_with("tls/")),
            Self::Connect(to) => to.starts_with("tls/"),
        }
    }

    /// True if all endpoints are `tls/` endpoints.
    #[must_use]
    pub fn is_encrypted(&self) -> bool {
        match self {
            Self::Listen(at) => at.iter().all(|endpoint| endpoint.starts_with("tls/")),
            Self::Connect(to) => to.starts_with("tls/"),
        }
    }
}

/// Begins the message of an error.
impl Display for LinkMode<'_> {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Listen(at) => write!(formatter, "cannot listen at {}", at.join(", ")),
            Self::Connect(to) => write!(formatter, "cannot connect to {to}"),
        }
    }
}

/// Priority of messages on a full link.
#[derive(Debug, Clone, Copy)]
pub enum Urgency {
    /// Small messages that the other end waits for.
    First,
    /// Policies.
    Policies,
    /// Segments.
    Segments,
}
