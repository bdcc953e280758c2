//! How a link is made, and how urgent its messages are.

/// How an end of a link makes its connection.
#[derive(Debug, Clone, Copy)]
pub enum LinkMode<'a> {
    /// The learner's host, which listens on these endpoints.
    Listen(&'a [String]),
    /// Another host, which connects to this endpoint.
    Connect(&'a str),
}

impl LinkMode<'_> {
    /// True if all endpoints are `tls/` endpoints.
    #[must_use]
    pub fn is_encrypted(&self) -> bool {
        match self {
            Self::Listen(at) => at.iter().all(|endpoint| endpoint.starts_with("tls/")),
            Self::Connect(to) => to.starts_with("tls/"),
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
