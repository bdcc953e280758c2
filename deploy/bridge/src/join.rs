//! A host's request to join a run, sent by `dmprl bridge` and again by its relay.

use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use anyhow::Context;

use super::handshake::{HostMessage, Received, join_key, read_answer};
use super::host_messages::{HostAnswer, HostRequest, HostWelcome, Lease};
use super::keys::Key;
use super::link::Link;

/// Name of the request to join a run.
pub(super) const JOIN: &str = "dmprl/join";
/// Time limit for an answer, which takes one round trip.
const ANSWER_LIMIT: Duration = Duration::from_secs(3);
/// Time limit to connect to one address of a host that does not answer, and the number of its
/// addresses that are tried.
const PROBE_LIMIT: Duration = Duration::from_secs(1);
const PROBES_MAX: usize = 2;

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
    Welcome(Box<Admission>),
    /// No gateway that knows the token answers.
    Silent,
    /// No room at present, for this reason.
    Later(String),
    /// Rejected; another request would be rejected too.
    Refused(String),
}

/// The answer to a host that has joined, with its session key.
#[derive(Debug)]
pub struct Admission {
    /// The gateway's answer.
    pub welcome: HostWelcome,
    /// Key from which those of all later messages are derived; `None` if they are not sealed.
    pub session: Option<Key>,
}

/// Sends one request to join. A host that returns names its previous lease. Answers without a proof
/// that their author knows the token are ignored.
///
/// # Errors
/// The session is closed.
pub fn request_join(
    link: &Link,
    settings: &JoinSettings,
    lease: Option<Lease>,
) -> anyhow::Result<JoinOutcome> {
    let JoinSettings { token, host, name, workers, .. } = settings;
    let key = join_key(token);
    let challenge = match ask(link, &key, &HostMessage::hello()?)? {
        Some(Received { answer: HostAnswer::Challenge(challenge), .. }) => challenge,
        other => return Ok(outcome(other, link)),
    };
    let (host, name, workers) = (*host, name.clone(), *workers);
    let request = HostRequest { host, name, workers, sealed: !link.is_authenticated(), lease };
    Ok(outcome(ask(link, &key, &HostMessage::join(&key, challenge, &request)?)?, link))
}

/// Sends a message and waits for a proven answer.
fn ask(link: &Link, key: &Key, message: &HostMessage) -> anyhow::Result<Option<Received>> {
    let payload = serde_json::to_vec(message).context("cannot write a request")?;
    link.request(JOIN, payload.clone(), ANSWER_LIMIT, |answer| read_answer(key, &payload, answer))
}

fn outcome(received: Option<Received>, link: &Link) -> JoinOutcome {
    let Some(Received { answer, session }) = received else { return JoinOutcome::Silent };
    match answer {
        HostAnswer::Welcome(welcome) if welcome.sealed || link.is_authenticated() => {
            let session = welcome.sealed.then_some(session);
            JoinOutcome::Welcome(Box::new(Admission { welcome: *welcome, session }))
        }
        HostAnswer::Welcome(_) => {
            JoinOutcome::Refused("it does not seal its messages on this link".to_owned())
        }
        HostAnswer::Refused { reason, later: true } => JoinOutcome::Later(reason),
        HostAnswer::Refused { reason, later: false } => JoinOutcome::Refused(reason),
        HostAnswer::Challenge(_) => JoinOutcome::Later("the challenge has changed".to_owned()),
    }
}

/// Describes why no gateway answers. Only a connection can tell a missing host from a wrong token.
#[must_use]
pub fn explain_silence(endpoint: &str) -> String {
    let address = endpoint.split_once('/').map_or(endpoint, |(_, address)| address);
    let address = address.split(['?', '#']).next().unwrap_or(address);
    let addresses = address.to_socket_addrs().into_iter().flatten();
    let connects = |at| TcpStream::connect_timeout(&at, PROBE_LIMIT).is_ok();
    if addresses.take(PROBES_MAX).any(connects) {
        return format!(
            "{endpoint} accepts connections, but no learner's host with this token answers: if the \
             run has started there, copy bridge.token of its directory again"
        );
    }
    format!("no learner's host answers at {endpoint}")
}
