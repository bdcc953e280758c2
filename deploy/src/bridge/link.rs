//! Zenoh, and nothing else: a session between hosts, and what is sent through it.
//!
//! Endpoints are explicit and nobody is looked for, so nobody is found by accident. A session mends
//! itself: it connects again as long as it lives. Messages between two ends that are there come in
//! order and once; what was under way when a link broke is lost, and found missing by whoever
//! numbers it.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context, anyhow};
use zenoh::handlers::{FifoChannel, FifoChannelHandler};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Config, Session, Wait};

use crate::failure::wrong_use;

/// Messages that wait to be taken; more, and the link is not read: its sender waits.
const WAITING_MAX: usize = 256;
/// A peer of which nothing is heard for so long is gone \[ms\]; it speaks a few times in it.
const LEASE_MS: u64 = 4_000;
/// Between two tries to connect: at first, and at most \[ms\].
const RETRY_FIRST_MS: u64 = 250;
const RETRY_MAX_MS: u64 = 2_000;
/// A longer message is nobody's \[bytes\]: to a host a policy of any size comes,
const POLICY_BYTES_MAX: usize = 256 << 20;
/// to the learner's host a few hundred KiB of segments, or one that is longer.
const BATCH_BYTES_MAX: usize = 16 << 20;
/// Other ends of the learner's host.
const SESSIONS_MAX: usize = 256;

/// Which end of a link.
#[derive(Debug, Clone, Copy)]
pub enum Ends<'a> {
    /// The learner's host, at these endpoints.
    Listen(&'a [String]),
    /// Another host, to this endpoint.
    Connect(&'a str),
}

/// An open session.
#[derive(Debug)]
pub struct Link(Session);

/// What goes first where a link is full.
#[derive(Debug, Clone, Copy)]
pub enum Urgency {
    /// Small and awaited.
    First,
    /// Policies.
    Policies,
    /// Segments.
    Segments,
}

/// Where messages of one name go out.
#[derive(Debug)]
pub struct Outlet(Publisher<'static>);

/// Where messages come in.
#[derive(Debug)]
pub struct Inlet(Subscriber<FifoChannelHandler<Sample>>);

/// A message.
#[derive(Debug)]
pub struct Message(Sample);

/// Where questions come in.
#[derive(Debug)]
pub struct Questions(Queryable<FifoChannelHandler<Query>>);

/// A question that waits for its answer.
#[derive(Debug)]
pub struct Question(Query);

/// Says that this end lives, until it is dropped or the link is gone.
#[derive(Debug)]
pub struct Token(#[expect(dead_code, reason = "it is there as long as this is")] LivelinessToken);

fn failed(what: impl std::fmt::Display) -> impl FnOnce(zenoh::Error) -> anyhow::Error {
    move |error| anyhow!("{what}: {error}")
}

fn config(ends: Ends<'_>, zenoh_file: Option<&Path>) -> anyhow::Result<Config> {
    let mut config = match zenoh_file {
        None => Config::default(),
        Some(path) => Config::from_file(path).map_err(|error| {
            wrong_use(format!("{}: not a configuration of Zenoh: {error}", path.display()))
        })?,
    };
    let endpoints = |endpoints: &[String]| serde_json::to_string(endpoints);
    let (listen, connect, bytes_max) = match ends {
        Ends::Listen(at) => (endpoints(at)?, endpoints(&[])?, BATCH_BYTES_MAX),
        Ends::Connect(to) => (endpoints(&[])?, endpoints(&[to.to_owned()])?, POLICY_BYTES_MAX),
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
        // It goes on trying behind our back, for ever: -1; who asks has a limit.
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
    /// Opens a session. Who connects need not be answered yet; who listens must be able to.
    ///
    /// # Errors
    /// Wrong use: the file is no configuration of Zenoh. An endpoint cannot be listened at.
    pub fn open(ends: Ends<'_>, zenoh_file: Option<&Path>) -> anyhow::Result<Self> {
        let what = match ends {
            Ends::Listen(at) => format!("cannot listen at {}", at.join(", ")),
            Ends::Connect(to) => format!("cannot connect to {to}"),
        };
        zenoh::open(config(ends, zenoh_file)?).wait().map(Self).map_err(failed(what))
    }

    /// Messages of this name will go out. Where the link is full, whoever sends waits.
    ///
    /// # Errors
    /// The session is closed.
    pub fn outlet(&self, name: String, urgency: Urgency) -> anyhow::Result<Outlet> {
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
        publisher.map(Outlet).map_err(what)
    }

    /// Messages of this name come in; `*` stands for any part of it.
    ///
    /// # Errors
    /// The session is closed.
    pub fn inlet(&self, name: &str) -> anyhow::Result<Inlet> {
        let channel = FifoChannel::new(WAITING_MAX);
        let subscriber = self.0.declare_subscriber(name.to_owned()).with(channel).wait();
        subscriber.map(Inlet).map_err(failed(format!("cannot receive {name}")))
    }

    /// Questions of this name come in.
    ///
    /// # Errors
    /// The session is closed.
    pub fn questions(&self, name: &str) -> anyhow::Result<Questions> {
        let channel = FifoChannel::new(WAITING_MAX);
        let queryable = self.0.declare_queryable(name.to_owned()).with(channel).wait();
        queryable.map(Questions).map_err(failed(format!("cannot answer {name}")))
    }

    /// Asks, and waits so long for the answer; none when nobody is there.
    ///
    /// # Errors
    /// The session is closed.
    pub fn ask(
        &self,
        name: &str,
        question: Vec<u8>,
        limit: Duration,
    ) -> anyhow::Result<Option<Vec<u8>>> {
        let asked = self.0.get(name).payload(question).timeout(limit).wait();
        let answers = asked.map_err(failed(format!("cannot ask {name}")))?;
        // Zenoh's own limit is kept; this one is for when it is not.
        let answer = answers.recv_timeout(limit * 2);
        let Ok(Some(reply)) = answer else { return Ok(None) };
        Ok(reply.into_result().ok().map(|sample| sample.payload().to_bytes().into_owned()))
    }

    /// Says that this end lives.
    ///
    /// # Errors
    /// The session is closed.
    pub fn token(&self, name: String) -> anyhow::Result<Token> {
        let what = failed(format!("cannot show {name}"));
        self.0.liveliness().declare_token(name).wait().map(Token).map_err(what)
    }

    /// Tells of other ends that come (with those that are there already) and go.
    ///
    /// # Errors
    /// The session is closed.
    pub fn tokens(&self, name: &str) -> anyhow::Result<Inlet> {
        let channel = FifoChannel::new(WAITING_MAX);
        let liveliness = self.0.liveliness();
        let subscriber =
            liveliness.declare_subscriber(name.to_owned()).history(true).with(channel).wait();
        subscriber.map(Inlet).map_err(failed(format!("cannot look for {name}")))
    }
}

impl Outlet {
    /// Sends, waiting where the link is full. To an end that is not there nothing is sent.
    ///
    /// # Errors
    /// The session is closed.
    pub fn send(&self, message: Vec<u8>) -> anyhow::Result<()> {
        self.0.put(message).wait().map_err(failed(format!("cannot send {}", self.0.key_expr())))
    }
}

impl Inlet {
    /// The next message, if one is there.
    ///
    /// # Errors
    /// The session is closed.
    pub fn next(&self) -> anyhow::Result<Option<Message>> {
        let next = self.0.try_recv().map_err(|error| anyhow!("{error}"));
        Ok(next.with_context(|| format!("cannot receive {}", self.0.key_expr()))?.map(Message))
    }
}

impl Message {
    /// What stands behind the last `/` of its name.
    #[must_use]
    pub fn last_name(&self) -> &str {
        let name = self.0.key_expr().as_str();
        name.rsplit_once('/').map_or(name, |(_, last)| last)
    }

    /// What it says.
    #[must_use]
    pub fn bytes(&self) -> std::borrow::Cow<'_, [u8]> {
        self.0.payload().to_bytes()
    }

    /// Of a token: whether it has come; it has gone otherwise.
    #[must_use]
    pub fn has_come(&self) -> bool {
        self.0.kind() == SampleKind::Put
    }
}

impl Questions {
    /// The next question, if one is there.
    ///
    /// # Errors
    /// The session is closed.
    pub fn next(&self) -> anyhow::Result<Option<Question>> {
        let next = self.0.try_recv().map_err(|error| anyhow!("{error}"));
        Ok(next.context("cannot take questions")?.map(Question))
    }
}

impl Question {
    /// What is asked.
    #[must_use]
    pub fn bytes(&self) -> Vec<u8> {
        self.0.payload().map(|payload| payload.to_bytes().into_owned()).unwrap_or_default()
    }

    /// Answers; whoever asked may be gone.
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
        // What is still to be sent is sent; a link that is gone keeps nobody waiting.
        let _ = self.0.close().wait();
    }
}
