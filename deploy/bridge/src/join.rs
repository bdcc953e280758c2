//! A host's request to join a run, sent by `dmprl bridge` and again by its relay.

use std::time::Duration;

use anyhow::Context;
use dmprl_control::Greeting;

use super::host_messages::{HostAnswer, HostRequest, HostWelcome, Lease};
use super::link::Link;

/// Name of the request to join a run.
pub(super) const JOIN: &str = "dmprl/join";
/// Time limit for an answer, which takes one round trip.
const ANSWER_LIMIT: Duration = Duration::from_secs(3);

/// Which run a host asks to join, and with how many workers.
#[derive(Debug, Clone)]
pub struct JoinSettings {
    /// Endpoint of the learner's host.
    pub endpoint: String,
    /// Token of the run.
    pub token: String,
    /// Random number that identifies this start of the program.
    pub host: u64,
    /// Name of the host, for display.
    pub name: String,
    /// Number of workers.
    pub workers: u32,
}

/// Result of one request to join.
#[derive(Debug)]
pub enum JoinOutcome {
    /// The host has joined.
    Welcome(Box<HostWelcome>),
    /// No answer, or no room at present.
    Later(String),
    /// Rejected; another request would be rejected too.
    Refused(String),
}

/// Sends one request to join. A host that returns names its previous lease.
///
/// # Errors
/// The session is closed.
pub fn request_join(
    link: &Link,
    settings: &JoinSettings,
    lease: Option<Lease>,
) -> anyhow::Result<JoinOutcome> {
    let JoinSettings { endpoint, token, host, name, workers } = settings;
    let request = HostRequest {
        speaks: Greeting::this(),
        token: token.clone(),
        host: *host,
        name: name.clone(),
        workers: *workers,
        lease,
    };
    let payload = serde_json::to_vec(&request).context("cannot write a request")?;
    let Some(answer) = link.request(JOIN, payload, ANSWER_LIMIT)? else {
        return Ok(JoinOutcome::Later(format!("no learner's host answers at {endpoint}")));
    };
    Ok(match serde_json::from_slice(&answer) {
        Ok(HostAnswer::Welcome(welcome)) => JoinOutcome::Welcome(welcome),
        Ok(HostAnswer::Refused { reason, later: true }) => JoinOutcome::Later(reason),
        Ok(HostAnswer::Refused { reason, later: false }) => JoinOutcome::Refused(reason),
        Err(error) => JoinOutcome::Refused(format!("{endpoint} sent an invalid answer: {error}")),
    })
}
