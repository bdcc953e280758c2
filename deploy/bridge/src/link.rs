//! The only module that uses Zenoh: a session between hosts and its messages.
//!
//! Endpoints are explicit and scouting is off, so hosts never find each other by accident. A
//! session reconnects automatically as long as it lives. While both ends are connected, messages
//! arrive once and in order. A link that breaks loses the messages in flight; receivers detect this
//! by sequence numbers.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context, anyhow};
use dmprl_run::failure::wrong_use;
use zenoh::handlers::{FifoChannel, FifoChannelHandler};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Config, Session, Wait};

use crate::{LinkMode, Urgency};

/// Capacity of a queue of received messages. If it is full, the link is not read and its sender
/// blocks.
const WAITING_MAX: usize = 256;
/// Time without any message after which a peer counts as gone \[ms\]. It sends several keep-alives
/// within this time.
const LEASE_MS: u64 = 4_000;
/// Initial and maximum interval between attempts to connect \[ms\].
const RETRY_FIRST_MS: u64 = 250;
const RETRY_MAX_MS: u64 = 2_000;
/// Maximum size of a message to a host, which may be a policy \[bytes\].
const POLICY_BYTES_MAX: usize = 256 << 20;
/// Maximum size of a message to the learner's host \[bytes\]: a few hundred KiB of segments, or one
/// longer segment.
const BATCH_BYTES_MAX: usize = 16 << 20;
/// Maximum number of sessions with the learner's host.
const SESSIONS_MAX: usize = 256;

/// An open session.
#[derive(Debug)]
pub struct Link(Session);

/// Sends messages under one name.
#[derive(Debug)]
pub struct MessageSender(Publisher<'static>);

/// Receives messages under a name or pattern.
#[derive(Debug)]
pub struct MessageReceiver(Subscriber<FifoChannelHandler<Sample>>);

/// A received message.
#[derive(Debug)]
pub struct Message(Sample);

/// Receives requests under a name.
#[derive(Debug)]
pub struct Requests(Queryable<FifoChannelHandler<Query>>);

/// A request that has not been answered yet.
#[derive(Debug)]
pub struct Request(Query);

/// Announces to the peers that this end is alive, until it is dropped or the link breaks.
#[derive(Debug)]
pub struct Presence(
    #[expect(dead_code, reason = "dropping it ends the announcement")] LivelinessToken,
);

fn failed(what: impl std::fmt::Display) -> impl FnOnce(zenoh::Error) -> anyhow::Error {
    move |error| anyhow!("{what}: {error}")
}

fn config(mode: LinkMode<'_>, zenoh_file: Option<&Path>) -> anyhow::Result<Config> {
    let mut config = match zenoh_file {
        None => Config::default(),
        Some(path) => Config::from_file(path).map_err(|error| {
            wrong_use(format!("{}: not a configuration of Zenoh: {error}", path.display()))
        })?,
    };
    let endpoints = |endpoints: &[String]| serde_json::to_string(endpoints);
    let (listen, connect, bytes_max) = match mode {
        LinkMode::Listen(at) => (endpoints(at)?, endpoints(&[])?, BATCH_BYTES_MAX),
        LinkMode::Connect(to) => (endpoints(&[])?, endpoints(&[to.to_owned()])?, POLICY_BYTES_MAX),
    };
    let retry = format!(
        "{{period_init_ms: {RETRY_FIRST_MS}, period_max_ms: {RETRY_MAX_MS}, \
         period_increase_factor: 2}}"
    );
    for (key, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("listen/endpoints", listen),
        ("connect/endpoints", connect),
        ("connect/exit_on_failure", "false".to_owned()),
        // Zenoh retries forever in the background (-1); callers have their own limit.
        ("connect/timeout_ms", "-1".to_owned()),
        ("connect/retry", retry),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("transport/link/tx/lease", LEASE_MS.to_string()),
        ("transport/link/rx/max_message_size", bytes_max.to_string()),
        ("transport/unicast/max_sessions", SESSIONS_MAX.to_string()),
    ] {
        config
            .insert_json5(key, &value)
            .map_err(failed(format!("cannot set {key} of Zenoh to {value}")))?;
    }
    Ok(config)
}

impl Link {
    /// Opens a session. A connecting end need not reach its peer yet; a listening end must succeed.
    ///
    /// # Errors
    /// Wrong use: the file is no configuration of Zenoh. Cannot listen on an endpoint.
    pub fn open(mode: LinkMode<'_>, zenoh_file: Option<&Path>) -> anyhow::Result<Self> {
        let what = match mode {
            LinkMode::Listen(at) => format!("cannot listen at {}", at.join(", ")),
            LinkMode::Connect(to) => format!("cannot connect to {to}"),
        };
        zenoh::open(config(mode, zenoh_file)?).wait().map(Self).map_err(failed(what))
    }

    /// Declares that messages of this name will be sent. On a full link the sender blocks.
    ///
    /// # Errors
    /// The session is closed.
    pub fn sender(&self, name: String, urgency: Urgency) -> anyhow::Result<MessageSender> {
        let priority = match urgency {
            Urgency::First => Priority::InteractiveHigh,
            Urgency::Policies => Priority::DataHigh,
            Urgency::Segments => Priority::Data,
        };
        let what = failed(format!("cannot send {name}"));
        let publisher = self
            .0
            .declare_publisher(name)
            .congestion_control(CongestionControl::Block)
            .priority(priority)
            .wait();
        publisher.map(MessageSender).map_err(what)
    }

    /// Subscribes to messages of this name; `*` stands for any part of it.
    ///
    /// # Errors
    /// The session is closed.
    pub fn receiver(&self, name: &str) -> anyhow::Result<MessageReceiver> {
        let channel = FifoChannel::new(WAITING_MAX);
        let subscriber = self.0.declare_subscriber(name.to_owned()).with(channel).wait();
        subscriber.map(MessageReceiver).map_err(failed(format!("cannot receive {name}")))
    }

    /// Declares that requests of this name will be answered.
    ///
    /// # Errors
    /// The session is closed.
    pub fn requests(&self, name: &str) -> anyhow::Result<Requests> {
        let channel = FifoChannel::new(WAITING_MAX);
        let queryable = self.0.declare_queryable(name.to_owned()).with(channel).wait();
        queryable.map(Requests).map_err(failed(format!("cannot answer {name}")))
    }

    /// Sends a request and waits for the answer, up to `limit`; `None` if no peer answers.
    ///
    /// # Errors
    /// The session is closed.
    pub fn request(
        &self,
        name: &str,
        payload: Vec<u8>,
        limit: Duration,
    ) -> anyhow::Result<Option<Vec<u8>>> {
        let sent = self.0.get(name).payload(payload).timeout(limit).wait();
        let answers = sent.map_err(failed(format!("cannot request {name}")))?;
        // A safeguard: Zenoh normally applies its own limit.
        let answer = answers.recv_timeout(limit * 2);
        let Ok(Some(reply)) = answer else { return Ok(None) };
        Ok(reply.into_result().ok().map(|sample| sample.payload().to_bytes().into_owned()))
    }

    /// Announces to the peers that this end is alive.
    ///
    /// # Errors
    /// The session is closed.
    pub fn announce(&self, name: String) -> anyhow::Result<Presence> {
        let what = failed(format!("cannot announce {name}"));
        self.0.liveliness().declare_token(name).wait().map(Presence).map_err(what)
    }

    /// Subscribes to the arrival and departure of other ends, including those already present.
    ///
    /// # Errors
    /// The session is closed.
    pub fn presences(&self, name: &str) -> anyhow::Result<MessageReceiver> {
        let channel = FifoChannel::new(WAITING_MAX);
        let liveliness = self.0.liveliness();
        let subscriber =
            liveliness.declare_subscriber(name.to_owned()).history(true).with(channel).wait();
        subscriber.map(MessageReceiver).map_err(failed(format!("cannot watch {name}")))
    }
}

impl MessageSender {
    /// Sends a message; blocks on a full link. Without a connected peer the message is dropped.
    ///
    /// # Errors
    /// The session is closed.
    pub fn send(&self, message: Vec<u8>) -> anyhow::Result<()> {
        self.0.put(message).wait().map_err(failed(format!("cannot send {}", self.0.key_expr())))
    }
}

impl MessageReceiver {
    /// Returns the next message, without waiting.
    ///
    /// # Errors
    /// The session is closed.
    pub fn next(&self) -> anyhow::Result<Option<Message>> {
        let next = self.0.try_recv().map_err(|error| anyhow!("{error}"));
        Ok(next.with_context(|| format!("cannot receive {}", self.0.key_expr()))?.map(Message))
    }
}

impl Message {
    /// The part of the message's name after the last `/`.
    #[must_use]
    pub fn last_name(&self) -> &str {
        let name = self.0.key_expr().as_str();
        name.rsplit_once('/').map_or(name, |(_, last)| last)
    }

    /// Payload of the message.
    #[must_use]
    pub fn bytes(&self) -> std::borrow::Cow<'_, [u8]> {
        self.0.payload().to_bytes()
    }

    /// For a presence: true if the end has arrived, false if it is gone.
    #[must_use]
    pub fn is_arrival(&self) -> bool {
        self.0.kind() == SampleKind::Put
    }
}

impl Requests {
    /// Returns the next request, without waiting.
    ///
    /// # Errors
    /// The session is closed.
    pub fn next(&self) -> anyhow::Result<Option<Request>> {
        let next = self.0.try_recv().map_err(|error| anyhow!("{error}"));
        Ok(next.context("cannot receive requests")?.map(Request))
    }
}

impl Request {
    /// Payload of the request.
    #[must_use]
    pub fn bytes(&self) -> Vec<u8> {
        self.0.payload().map(|payload| payload.to_bytes().into_owned()).unwrap_or_default()
    }

    /// Sends the answer; succeeds even if the requester is gone.
    ///
    /// # Errors
    /// The session is closed.
    pub fn answer(&self, answer: Vec<u8>) -> anyhow::Result<()> {
        let name = self.0.key_expr().clone();
        self.0.reply(name, answer).wait().map_err(failed("cannot answer"))
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        // Flushes pending messages; a broken link does not block it.
        let _ = self.0.close().wait();
    }
}
