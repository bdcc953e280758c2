//! A session of Zenoh between hosts, and its messages.
//!
//! Endpoints are explicit and scouting is off, so hosts never find each other by accident. A
//! session reconnects automatically as long as it lives. While both ends are connected, messages
//! arrive once and in order. A link that breaks loses the messages in flight; receivers detect this
//! by sequence numbers.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use zenoh::handlers::{FifoChannel, FifoChannelHandler};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{ConsolidationMode, Query, Queryable};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use crate::link_config::LinkConfig;
use crate::tls_tunnel::TlsTunnel;
use crate::{LinkMode, Urgency};

/// Capacity of a queue of received messages. If it is full, the link is not read and its sender
/// blocks.
const WAITING_MAX: usize = 256;
/// Maximum number of requests that wait for the gateway, and their maximum size \[bytes\]. Further
/// and larger ones are dropped and counted: 256 KiB for all.
const REQUESTS_WAITING_MAX: usize = 64;
const REQUEST_BYTES_MAX: usize = 4_096;

/// An open session.
#[derive(Debug)]
pub struct Link {
    session: Session,
    is_authenticated: bool,
    /// Dropped after the session is closed.
    tunnel: Option<TlsTunnel>,
}

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
pub struct Requests {
    waiting: Receiver<Query>,
    dropped: Arc<AtomicU64>,
    _queryable: Queryable<()>,
}

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

impl Link {
    /// Opens a session with ends that know the same token. A connecting end need not reach its peer
    /// yet; a listening end must succeed.
    ///
    /// # Errors
    /// Wrong use: the file is no configuration of Zenoh. Cannot listen on an endpoint.
    pub fn open(
        mode: LinkMode<'_>,
        token: &str,
        zenoh_file: Option<&Path>,
    ) -> anyhow::Result<Self> {
        let configured = LinkConfig::new(mode, token, zenoh_file)?;
        let LinkConfig { config, is_authenticated, tunnel, passwords } = configured;
        let session = zenoh::open(config).wait().map_err(failed(mode))?;
        drop(passwords);
        Ok(Self { session, is_authenticated, tunnel })
    }

    /// Number of connections that were refused because they did not prove that they know the token.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.tunnel.as_ref().map_or(0, TlsTunnel::refused)
    }

    /// True if every peer of this session has a certificate of the run's authority.
    #[must_use]
    pub fn is_authenticated(&self) -> bool {
        self.is_authenticated
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
            .session
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
        let subscriber = self.session.declare_subscriber(name.to_owned()).with(channel).wait();
        subscriber.map(MessageReceiver).map_err(failed(format!("cannot receive {name}")))
    }

    /// Declares that requests of this name will be answered. Requests that are too large, or too
    /// many at once, are dropped and counted.
    ///
    /// # Errors
    /// The session is closed.
    pub fn requests(&self, name: &str) -> anyhow::Result<Requests> {
        let (queue, waiting) = sync_channel(REQUESTS_WAITING_MAX);
        let dropped = Arc::new(AtomicU64::new(0));
        let counted = Arc::clone(&dropped);
        let receive = move |query: Query| {
            let fits = query.payload().is_none_or(|payload| payload.len() <= REQUEST_BYTES_MAX);
            if !fits || queue.try_send(query).is_err() {
                counted.fetch_add(1, Ordering::Relaxed);
            }
        };
        let queryable = self.session.declare_queryable(name.to_owned()).callback(receive).wait();
        let queryable = queryable.map_err(failed(format!("cannot answer {name}")))?;
        Ok(Requests { waiting, dropped, _queryable: queryable })
    }

    /// Sends a request and passes the answers to `accept` until it takes one, up to `limit`. `None`
    /// if it takes none.
    ///
    /// # Errors
    /// The session is closed.
    pub fn request<T>(
        &self,
        name: &str,
        payload: Vec<u8>,
        limit: Duration,
        mut accept: impl FnMut(&[u8]) -> Option<T>,
    ) -> anyhow::Result<Option<T>> {
        // Otherwise Zenoh would pass on only one of several answers.
        let request = self.session.get(name).consolidation(ConsolidationMode::None);
        let sent = request.payload(payload).timeout(limit).wait();
        let answers = sent.map_err(failed(format!("cannot request {name}")))?;
        // A safeguard: Zenoh normally applies its own limit.
        let deadline = Instant::now() + limit * 2;
        while let Ok(Some(reply)) = answers.recv_deadline(deadline) {
            let Ok(sample) = reply.into_result() else { continue };
            if let Some(taken) = accept(&sample.payload().to_bytes()) {
                return Ok(Some(taken));
            }
        }
        Ok(None)
    }

    /// Announces to the peers that this end is alive.
    ///
    /// # Errors
    /// The session is closed.
    pub fn announce(&self, name: String) -> anyhow::Result<Presence> {
        let what = failed(format!("cannot announce {name}"));
        self.session.liveliness().declare_token(name).wait().map(Presence).map_err(what)
    }

    /// Subscribes to the arrival and departure of other ends, including those already present.
    ///
    /// # Errors
    /// The session is closed.
    pub fn presences(&self, name: &str) -> anyhow::Result<MessageReceiver> {
        let channel = FifoChannel::new(WAITING_MAX);
        let liveliness = self.session.liveliness();
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
        match self.waiting.try_recv() {
            Ok(query) => Ok(Some(Request(query))),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => bail!("cannot receive requests"),
        }
    }

    /// Number of requests that were dropped: too large, or too many at once.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
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
        let _ = self.session.close().wait();
    }
}
