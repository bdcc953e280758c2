//! The learner's end of the bridge, which acts as the workers of all other hosts.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::segment::Segment;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::{Acknowledgements, Sent};
use dmprl_shared::transport::shared_memory::{
    AcknowledgementReader, Plan, Sender, Subscriber, attach_queue, hear, subscribe,
};
use dmprl_shared::transport::{AcknowledgementSubscriber, ParameterSubscriber, TransportError};

use super::feed::Feed;
use super::landing::Landing;
use super::link::{Ends, Inlet, Link, Message, Outlet, Question, Questions, Token, Urgency};
use super::relay::JOIN;
use super::seats::{Host, Refusal, Seats};
use super::token;
use super::wire::{self, Course, Hearing, HostAnswer, HostRequest, HostStatus, HostWelcome};
use crate::control::{Greeting, HostNow};
use crate::run_directory::random_u64;

/// Interval of hearings if an acknowledgement has changed.
const HEARING_INTERVAL: Duration = Duration::from_millis(5);
/// Interval of hearings if nothing has changed.
const ALIVE_INTERVAL: Duration = Duration::from_millis(250);
/// Interval between attempts to attach to a worker's queue. Its last user may not have been cleaned
/// up yet.
const ATTACH_INTERVAL: Duration = Duration::from_millis(50);
/// Time during which messages with seats of a previous gateway are tolerated. Hosts notice within
/// it that the gateway has died.
const FORMER: Duration = Duration::from_secs(15);
/// Maximum number of messages of one kind per turn.
const MESSAGES_TOGETHER: usize = 64;
/// Maximum length of a host's name in characters.
const NAME_MAX: usize = 64;

/// Facts about the run that a joining host receives.
#[derive(Debug, Clone)]
pub struct RunFacts {
    /// Run id, as in the manifest.
    pub run_id: String,
    /// Configuration, as in `config.toml`.
    pub config: String,
    /// Spec of the environment.
    pub spec: EnvSpec,
    /// Token of the run.
    pub token: String,
}

/// The queue of one worker, and the segments to be put into it.
struct Port {
    worker: usize,
    landing: Landing,
    queue: Option<Sender>,
}

/// Outgoing messages to a host.
struct Outlets {
    hearings: Outlet,
    /// Created when the host first reports its status. Earlier it does not listen, and a policy
    /// would be lost.
    policies: Option<Feed>,
}

/// A message for the user, or counts for the supervisor.
#[derive(Debug, Clone, PartialEq)]
pub enum News {
    /// A message for the user.
    Told(String),
    /// Counts of segments of the workers of other hosts.
    Sent(Sent),
    /// Failures of environments on a host.
    EnvFailures {
        /// Number of failures.
        count: u64,
        /// Name of the host.
        host: String,
    },
}

/// The gateway of a run.
pub struct Gateway {
    link: Link,
    questions: Questions,
    segments: Inlet,
    statuses: Inlet,
    tokens: Inlet,
    facts: RunFacts,
    domain: PathBuf,
    plan: Plan,
    capacity: usize,
    seats: Seats,
    outlets: BTreeMap<u64, Outlets>,
    ports: BTreeMap<usize, Port>,
    acknowledgements: AcknowledgementReader,
    heard: Acknowledgements,
    policies: Subscriber,
    snapshot: ParameterSnapshot,
    policy: Option<(u64, Arc<Vec<u8>>)>,
    buffer: Segment,
    changed: bool,
    told: Instant,
    attached: Instant,
    /// Messages that are damaged or have an unknown seat.
    refused: u64,
    /// Rejected join requests. The user is told of the first, then at each power of two.
    refusals: u64,
    /// Last time that a host received a new seat from this gateway or its predecessor.
    reseated: Instant,
    id: u64,
    _token: Token,
    news: Vec<News>,
}

impl Gateway {
    /// Opens session `session` (from 0) of the run to other hosts, whose first worker is `first`.
    ///
    /// # Errors
    /// Cannot listen on an endpoint, or cannot attach to the learner's shared memory.
    pub fn open(
        (endpoints, zenoh_file): (&[String], Option<&Path>),
        (domain, plan): (&Path, Plan),
        (first, session, capacity): (usize, u32, usize),
        facts: RunFacts,
    ) -> anyhow::Result<Self> {
        let acknowledgements = hear(domain, &plan)?;
        let policies = subscribe(domain, &plan)?;
        let link = Link::open(Ends::Listen(endpoints), zenoh_file)?;
        let all = |what: &str| format!("dmprl/{}/{what}/*", facts.run_id);
        let places = u32::try_from(plan.worker_count - first).context("too many places")?;
        let first_worker = u32::try_from(first).context("too many workers")?;
        let (now, id) = (Instant::now(), random_u64()?);
        Ok(Self {
            segments: link.inlet(&all("segments"))?,
            statuses: link.inlet(&all("status"))?,
            tokens: link.tokens(&all("hosts"))?,
            // Last, so that everything else is ready when a request arrives.
            questions: link.questions(JOIN)?,
            domain: domain.to_owned(),
            buffer: Segment::zeroed(plan.layout),
            plan,
            capacity,
            seats: Seats::new(first_worker, places, session),
            outlets: BTreeMap::new(),
            ports: BTreeMap::new(),
            acknowledgements,
            heard: Acknowledgements::default(),
            policies,
            snapshot: ParameterSnapshot::default(),
            policy: None,
            changed: false,
            told: now,
            attached: now,
            refused: 0,
            refusals: 0,
            reseated: now,
            _token: link.token(format!("dmprl/{}/gateway/{id:016x}", facts.run_id))?,
            id,
            link,
            news: Vec::new(),
            facts,
        })
    }

    /// Runs one turn; returns true if there was anything to do.
    ///
    /// # Errors
    /// The transport or the session has failed permanently.
    pub fn turn(&mut self) -> anyhow::Result<bool> {
        let now = Instant::now();
        for _ in 0..MESSAGES_TOGETHER {
            let Some(question) = self.questions.next()? else { break };
            self.answer(&question, now)?;
        }
        self.watch(now)?;
        let mut worked = false;
        for _ in 0..MESSAGES_TOGETHER {
            let Some(message) = self.segments.next()? else { break };
            worked = true;
            self.land(&message, now);
        }
        self.attach(now)?;
        self.offer()?;
        if self.acknowledgements.newest(&mut self.heard)? {
            for port in self.ports.values_mut() {
                let mark = self.heard.marks.get(port.worker).copied().unwrap_or_default();
                port.landing.acknowledge(mark);
            }
            self.changed = true;
        }
        self.take_policy()?;
        let since = now.duration_since(self.told);
        if since >= ALIVE_INTERVAL || self.changed && since >= HEARING_INTERVAL {
            (self.told, self.changed) = (now, false);
            self.tell(Course::On)?;
        }
        Ok(worked)
    }

    /// Returns the news since the last call.
    pub fn news(&mut self) -> Vec<News> {
        std::mem::take(&mut self.news)
    }

    /// The state of all hosts, for display.
    #[must_use]
    pub fn hosts(&self) -> Vec<HostNow> {
        self.seats.hosts().iter().map(Host::shown).collect()
    }

    /// The policy version of each host.
    pub fn policy_versions(&self) -> impl Iterator<Item = u64> + '_ {
        let statuses = self.seats.hosts().iter().filter_map(|host| host.status.as_ref());
        statuses.map(|status| status.policy_version)
    }

    /// Returns true if every host that has not left has been silent for `for_so_long`.
    #[must_use]
    pub fn is_alone(&self, for_so_long: Duration) -> bool {
        self.seats.hosts().iter().all(|host| host.heard.elapsed() >= for_so_long)
    }

    /// The first unused session number, with which the next gateway of the run starts.
    #[must_use]
    pub fn session(&self) -> u32 {
        self.seats.session()
    }

    /// Sends all hosts the course of the run and the acknowledgements.
    ///
    /// # Errors
    /// The session is closed.
    pub fn tell(&mut self, course: Course) -> anyhow::Result<()> {
        for host in self.seats.hosts() {
            let Some(outlets) = self.outlets.get(&host.seat).filter(|_| host.here) else {
                continue;
            };
            let first = host.held.first as usize;
            let of = |index: u32| self.ports.get(&(first + index as usize));
            let hearings: Vec<_> = (0..host.workers)
                .map(|index| of(index).map(|port| port.landing.hearing()).unwrap_or_default())
                .collect();
            outlets.hearings.send(wire::write_hearings(course, &hearings))?;
        }
        Ok(())
    }

    /// Reads the hosts' liveliness tokens and status messages.
    ///
    /// # Errors
    /// The session is closed.
    pub fn watch(&mut self, now: Instant) -> anyhow::Result<()> {
        for _ in 0..MESSAGES_TOGETHER {
            let Some(message) = self.tokens.next()? else { break };
            self.on_token(&message, now);
        }
        for _ in 0..MESSAGES_TOGETHER {
            let Some(message) = self.statuses.next()? else { break };
            self.on_status(&message, now)?;
        }
        Ok(())
    }

    /// Reports a rejected request, less and less often: repeated requests must not fill the log.
    fn tell_of_refusal(&mut self, what: impl FnOnce() -> String) {
        self.refusals += 1;
        if self.refusals.is_power_of_two() {
            self.news.push(News::Told(what()));
        }
    }

    fn answer(&mut self, question: &Question, now: Instant) -> anyhow::Result<()> {
        let answer = match self.admit(&question.bytes(), now) {
            Ok(welcome) => HostAnswer::Welcome(Box::new(welcome)),
            Err(Refusal { reason, later }) => HostAnswer::Refused { reason, later },
        };
        question.answer(serde_json::to_vec(&answer).context("cannot write an answer")?)
    }

    fn admit(&mut self, bytes: &[u8], now: Instant) -> Result<HostWelcome, Refusal> {
        let never = |reason: String| Refusal { reason, later: false };
        // Parse the greeting first: another version's remaining fields may not parse.
        #[derive(serde::Deserialize)]
        struct Speaks {
            speaks: Greeting,
        }
        let this = Greeting::this();
        let Speaks { speaks } = serde_json::from_slice(bytes)
            .map_err(|_| never(format!("expected a request of {this}, got something else")))?;
        if speaks != this {
            let reason = format!("expected {this}, got {speaks}: start both from the same build");
            self.tell_of_refusal(|| format!("rejected a host with {speaks}"));
            return Err(never(reason));
        }
        let request: HostRequest = serde_json::from_slice(bytes)
            .map_err(|error| never(format!("expected a request, got another: {error}")))?;
        if !token::equal(&request.token, &self.facts.token) {
            self.tell_of_refusal(|| {
                let name = request.name.escape_debug().take(NAME_MAX).collect::<String>();
                format!("rejected host {name}: its token is wrong")
            });
            let reason = "its token is not the run's: copy bridge.token of the run's directory";
            return Err(never(reason.to_owned()));
        }
        if request.name.chars().count() > NAME_MAX {
            return Err(never(format!("its name has more than {NAME_MAX} characters (--name)")));
        }
        if self.heard.marks.is_empty() {
            let reason = "the learner has not reported its workers' progress yet".to_owned();
            return Err(Refusal { reason, later: true });
        }
        let seat = random_u64().map_err(|error| never(format!("{error:#}")))?;
        let known = self.seats.hosts().iter().find(|host| host.host == request.host);
        let before = known.map(|host| host.seat);
        // The command line has asked before; the relay's own request is no news for the user.
        let was_here = request.held.is_some() && known.is_some_and(|host| host.here);
        let held = self.seats.admit(&request, seat, (&self.heard.marks, now))?;
        if let Some(before) = before {
            self.outlets.remove(&before);
            self.reseated = now;
        }
        let outlets = self.outlets(seat).map_err(|error| never(format!("{error:#}")))?;
        self.outlets.insert(seat, outlets);
        for index in 0..request.workers {
            let worker = (held.first + index) as usize;
            let landing = || Landing::new(held.first + index, self.plan.layout, self.capacity);
            let port = || Port { worker, landing: landing(), queue: None };
            self.ports.entry(worker).or_insert_with(port);
        }
        if !was_here {
            let again = if request.held.is_some() { "is back" } else { "takes part" };
            let workers = request.workers;
            let counted = format!("{workers} worker{}", if workers == 1 { "" } else { "s" });
            let name = request.name.escape_debug();
            self.news.push(News::Told(format!("host {name} {again}: {counted}")));
        }
        let RunFacts { run_id, config, spec, .. } = self.facts.clone();
        Ok(HostWelcome { seat, gateway: self.id, held, run_id, config, spec })
    }

    fn outlets(&self, seat: u64) -> anyhow::Result<Outlets> {
        let name = format!("dmprl/{}/hearings/{seat:016x}", self.facts.run_id);
        let hearings = self.link.outlet(name, Urgency::First)?;
        Ok(Outlets { hearings, policies: None })
    }

    fn feed(&mut self, seat: u64, has: u64) -> anyhow::Result<()> {
        let name = format!("dmprl/{}/policies/{seat:016x}", self.facts.run_id);
        let Some(outlets) = self.outlets.get_mut(&seat) else { return Ok(()) };
        let feed = match &outlets.policies {
            Some(feed) => feed,
            None => {
                let feed = Feed::start(self.link.outlet(name, Urgency::Policies)?)?;
                if let Some((version, message)) = &self.policy {
                    feed.offer(*version, message);
                }
                outlets.policies.insert(feed)
            }
        };
        feed.confirm(has);
        Ok(())
    }

    /// Finds the sender by the seat in the message's name, which only this host and the gateway
    /// know.
    fn host(&mut self, message: &Message) -> Option<&mut Host> {
        let seat = u64::from_str_radix(message.last_name(), 16).ok()?;
        self.seats.of_seat(seat)
    }

    fn on_token(&mut self, message: &Message, now: Instant) {
        let here = message.has_come();
        let Some(host) = self.host(message) else { return };
        (host.here, host.heard) = (here, now);
        if !here {
            let name = host.name.escape_debug().to_string();
            self.news.push(News::Told(format!("host {name} is out of reach")));
        }
    }

    fn land(&mut self, message: &Message, now: Instant) {
        let Some(host) = self.host(message) else {
            self.refused += u64::from(now.duration_since(self.reseated) >= FORMER);
            return;
        };
        (host.heard, host.here) = (now, true);
        let places = host.held.first as usize..(host.held.first + host.workers) as usize;
        let Self { ports, buffer, refused, .. } = self;
        let read = wire::read_batch(&message.bytes(), buffer, |stretch, segment| {
            let port = Some(stretch.worker as usize).filter(|worker| places.contains(worker));
            match (port.and_then(|worker| ports.get_mut(&worker)), segment) {
                (Some(port), None) => port.landing.begin(stretch),
                (Some(port), Some(segment)) => port.landing.land(stretch, segment),
                (None, _) => *refused += 1,
            }
        });
        *refused += u64::from(read.is_err());
    }

    fn on_status(&mut self, message: &Message, now: Instant) -> anyhow::Result<()> {
        let Ok(mut status) = serde_json::from_slice::<HostStatus>(&message.bytes()) else {
            self.refused += 1;
            return Ok(());
        };
        let Some(host) = self.host(message) else { return Ok(()) };
        host.heard = now;
        let (name, seat) = (host.name.clone(), host.seat);
        if let Some(before) = &host.status {
            status.no_less_than(before);
        }
        // After a takeover, start to count from the host's current state.
        let before = host.status.replace(status.clone());
        let before = before.unwrap_or_else(|| match host.counted_before {
            true => status.clone(),
            false => HostStatus::default(),
        });
        self.feed(seat, status.policy_version)?;
        let sent = status.sent.since(&before.sent);
        if sent != Sent::default() {
            self.news.push(News::Sent(sent));
        }
        let count = status.env_failures.saturating_sub(before.env_failures);
        if count > 0 {
            self.news.push(News::EnvFailures { count, host: name.clone() });
        }
        if status.leaves {
            let workers = self.seats.remove(seat).map_or(0, |host| host.workers);
            if let Some(outlets) = self.outlets.remove(&seat) {
                let none = vec![Hearing::default(); workers as usize];
                outlets.hearings.send(wire::write_hearings(Course::Left, &none))?;
            }
            self.reseated = now;
            self.news.push(News::Told(format!("host {} has left", name.escape_debug())));
        }
        Ok(())
    }

    /// Attaches to the queues of workers that have arrived.
    fn attach(&mut self, now: Instant) -> anyhow::Result<()> {
        if now.duration_since(self.attached) < ATTACH_INTERVAL {
            return Ok(());
        }
        self.attached = now;
        for port in self.ports.values_mut().filter(|port| port.queue.is_none()) {
            match attach_queue(&self.domain, &self.plan, port.worker) {
                Ok(queue) => port.queue = Some(queue),
                Err(error @ TransportError::Incompatible { .. }) => return Err(error.into()),
                // The learner is being replaced, or the queue of a killed gateway is not free yet.
                Err(_) => {}
            }
        }
        Ok(())
    }

    fn offer(&mut self) -> anyhow::Result<()> {
        for port in self.ports.values_mut() {
            if let Some(queue) = &mut port.queue {
                port.landing.offer(queue)?;
            }
        }
        Ok(())
    }

    fn take_policy(&mut self) -> anyhow::Result<()> {
        match self.policies.newest(&mut self.snapshot) {
            Ok(true) => {
                let message = Arc::new(wire::write_snapshot(&self.snapshot));
                for feed in self.outlets.values().filter_map(|outlets| outlets.policies.as_ref()) {
                    feed.offer(self.snapshot.version, &message);
                }
                self.policy = Some((self.snapshot.version, message));
            }
            Ok(false) => {}
            // The snapshot was damaged; another one follows soon.
            Err(TransportError::Snapshot(error)) => {
                self.news.push(News::Told(format!("a policy snapshot is refused: {error}")));
            }
            Err(error) => return Err(error.into()),
        }
        Ok(())
    }

    /// Rejected messages and segments: damaged, of unknown senders, or inconsistent.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused + self.ports.values().map(|port| port.landing.misfits()).sum::<u64>()
    }

    /// Segments that the learner has not acknowledged yet.
    #[must_use]
    pub fn kept(&self) -> usize {
        self.ports.values().map(|port| port.landing.kept()).sum()
    }
}
