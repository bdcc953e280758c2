//! The learner's end of the bridge, which acts as the workers of all other hosts.

mod admission;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_control::HostNow;
use dmprl_run::random_u64;
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::segment::Segment;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::{Acknowledgements, Sent};
use dmprl_shared::transport::shared_memory::{
    AcknowledgementReader, Plan, Sender, Subscriber, attach_queue, hear, subscribe,
};
use dmprl_shared::transport::{AcknowledgementSubscriber, ParameterSubscriber, TransportError};

use super::handshake::Authenticator;
use super::host_messages::HostStatus;
use super::host_registry::{Host, HostRegistry};
use super::join::JOIN;
use super::keys::Key;
use super::link::{Link, Message, MessageReceiver, Presence, Requests};
use super::link_mode::{LinkMode, Urgency};
use super::link_receiver::LinkReceiver;
use super::policy_sender::PolicySender;
use super::seal::{Opener, SealedSender};
use super::wire::{self, LinkAck, RunState};

/// Interval between two messages of acknowledgements while segments are acknowledged.
const ACK_INTERVAL: Duration = Duration::from_millis(5);
/// Interval between two messages of acknowledgements if nothing has changed.
const ALIVE_INTERVAL: Duration = Duration::from_millis(250);
/// Interval between attempts to attach to a worker's queue. Its last user may not have been cleaned
/// up yet.
const ATTACH_INTERVAL: Duration = Duration::from_millis(50);
/// Time during which messages on channels of a previous gateway are tolerated. Hosts notice within
/// it that the gateway has died.
const OLD_CHANNELS_TOLERATED: Duration = Duration::from_secs(15);
/// Maximum number of messages of one kind per turn.
const MESSAGES_TOGETHER: usize = 64;

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

/// Where a gateway listens and which workers it acts for.
#[derive(Debug, Clone)]
pub struct GatewaySettings<'a> {
    /// Zenoh endpoints on which to listen.
    pub endpoints: &'a [String],
    /// Zenoh's own configuration file.
    pub zenoh_file: Option<&'a Path>,
    /// The run's shared-memory directory.
    pub domain: &'a Path,
    /// The learner's plan.
    pub plan: Plan,
    /// Index of the first worker of other hosts. All later workers of the plan are theirs, too.
    pub first_worker: usize,
    /// First session of the run that no host has been given, from 0.
    pub session: u32,
    /// Maximum number of retained segments of each worker.
    pub segments_max: usize,
}

/// A worker of another host: its retained segments, and its queue at the learner.
struct RemoteWorker {
    index: usize,
    receiver: LinkReceiver,
    queue: Option<Sender>,
}

/// The messages from and to a host.
struct HostChannel {
    /// Key of the handshake that opened this channel; `None` if its messages are not sealed.
    session: Option<Key>,
    segments: Opener,
    status: Opener,
    acks: SealedSender,
    /// Created when the host first reports its status. Before that it does not listen, and a
    /// policy would be lost.
    policies: Option<PolicySender>,
}

/// An event for the supervisor.
#[derive(Debug, Clone, PartialEq)]
pub enum GatewayEvent {
    /// A message for the user.
    Notice(String),
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
    requests: Requests,
    segments: MessageReceiver,
    statuses: MessageReceiver,
    presences: MessageReceiver,
    facts: RunFacts,
    domain: PathBuf,
    plan: Plan,
    segments_max: usize,
    registry: HostRegistry,
    channels: BTreeMap<u64, HostChannel>,
    workers: BTreeMap<usize, RemoteWorker>,
    acknowledgements: AcknowledgementReader,
    acknowledged: Acknowledgements,
    policies: Subscriber,
    snapshot: ParameterSnapshot,
    /// The newest policy: its version and its message.
    policy: Option<(u64, Arc<Vec<u8>>)>,
    buffer: Segment,
    /// Set if there are acknowledgements that have not been sent to the hosts.
    acks_due: bool,
    acks_sent: Instant,
    attach_tried: Instant,
    /// Messages that are damaged or forged, or come on an unknown channel.
    rejected: u64,
    authenticator: Authenticator,
    /// Rejected join requests. The first is reported to the user, then each power of two.
    refusals: u64,
    /// Last time that a host received a new channel from this gateway or its predecessor.
    channels_changed: Instant,
    id: u64,
    _presence: Presence,
    events: Vec<GatewayEvent>,
}

impl Gateway {
    /// Attaches to the learner and listens for other hosts.
    ///
    /// # Errors
    /// Cannot listen on an endpoint, or cannot attach to the learner's shared memory.
    pub fn open(settings: GatewaySettings<'_>, facts: RunFacts) -> anyhow::Result<Self> {
        let GatewaySettings { endpoints, domain, plan, first_worker, session, .. } = settings;
        let acknowledgements = hear(domain, &plan)?;
        let policies = subscribe(domain, &plan)?;
        let link = Link::open(LinkMode::Listen(endpoints), &facts.token, settings.zenoh_file)?;
        let all = |what: &str| format!("dmprl/{}/{what}/*", facts.run_id);
        let places = u32::try_from(plan.worker_count - first_worker).context("too many places")?;
        let first_worker = u32::try_from(first_worker).context("too many workers")?;
        let (now, id) = (Instant::now(), random_u64()?);
        Ok(Self {
            segments: link.receiver(&all("segments"))?,
            statuses: link.receiver(&all("status"))?,
            presences: link.presences(&all("hosts"))?,
            // Last, so that everything else is ready when a request arrives.
            requests: link.requests(JOIN)?,
            domain: domain.to_owned(),
            buffer: Segment::zeroed(plan.layout),
            plan,
            segments_max: settings.segments_max,
            registry: HostRegistry::new(first_worker, places, session),
            channels: BTreeMap::new(),
            workers: BTreeMap::new(),
            acknowledgements,
            acknowledged: Acknowledgements::default(),
            policies,
            snapshot: ParameterSnapshot::default(),
            policy: None,
            acks_due: false,
            acks_sent: now,
            attach_tried: now,
            rejected: 0,
            authenticator: Authenticator::new(&facts.token)?,
            refusals: 0,
            channels_changed: now,
            _presence: link.announce(format!("dmprl/{}/gateway/{id:016x}", facts.run_id))?,
            id,
            link,
            events: Vec::new(),
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
            let Some(request) = self.requests.next()? else { break };
            self.answer(&request, now)?;
        }
        self.read_statuses(now)?;
        let mut worked = false;
        for _ in 0..MESSAGES_TOGETHER {
            let Some(message) = self.segments.next()? else { break };
            worked = true;
            self.receive_segments(&message, now);
        }
        self.attach_queues(now)?;
        self.offer_segments()?;
        if self.acknowledgements.newest(&mut self.acknowledged)? {
            for worker in self.workers.values_mut() {
                let mark = self.acknowledged.marks.get(worker.index).copied().unwrap_or_default();
                worker.receiver.acknowledge(mark);
            }
            self.acks_due = true;
        }
        self.take_policy()?;
        let since = now.duration_since(self.acks_sent);
        if since >= ALIVE_INTERVAL || self.acks_due && since >= ACK_INTERVAL {
            (self.acks_sent, self.acks_due) = (now, false);
            self.send_acks(RunState::Running)?;
        }
        Ok(worked)
    }

    /// Returns the events since the last call.
    pub fn take_events(&mut self) -> Vec<GatewayEvent> {
        std::mem::take(&mut self.events)
    }

    /// The state of all hosts, for display.
    #[must_use]
    pub fn hosts(&self) -> Vec<HostNow> {
        self.registry.hosts().iter().map(Host::shown).collect()
    }

    /// The policy version of each host.
    pub fn policy_versions(&self) -> impl Iterator<Item = u64> + '_ {
        let statuses = self.registry.hosts().iter().filter_map(|host| host.status.as_ref());
        statuses.map(|status| status.policy_version)
    }

    /// Returns true if every host that has not left has been silent for at least `limit`.
    #[must_use]
    pub fn all_silent_for(&self, limit: Duration, now: Instant) -> bool {
        self.registry.hosts().iter().all(|host| now.duration_since(host.last_heard) >= limit)
    }

    /// The first unused session number, with which the next gateway of the run starts.
    #[must_use]
    pub fn session(&self) -> u32 {
        self.registry.session()
    }

    /// Sends all hosts the state of the run and the acknowledgements.
    ///
    /// # Errors
    /// The session is closed.
    pub fn send_acks(&mut self, state: RunState) -> anyhow::Result<()> {
        for host in self.registry.hosts() {
            let Some(channel) = self.channels.get_mut(&host.channel) else { continue };
            if !host.is_present {
                continue;
            }
            let first = host.lease.first as usize;
            let ack = |index: u32| {
                let worker = self.workers.get(&(first + index as usize));
                worker.map(|worker| worker.receiver.ack()).unwrap_or_default()
            };
            let acks: Vec<_> = (0..host.workers).map(ack).collect();
            channel.acks.send(wire::write_acks(state, &acks))?;
        }
        Ok(())
    }

    /// Reads the messages about hosts that come, go and report their status.
    ///
    /// # Errors
    /// The session is closed.
    pub fn read_statuses(&mut self, now: Instant) -> anyhow::Result<()> {
        for _ in 0..MESSAGES_TOGETHER {
            let Some(message) = self.presences.next()? else { break };
            self.on_presence(&message, now);
        }
        for _ in 0..MESSAGES_TOGETHER {
            let Some(message) = self.statuses.next()? else { break };
            self.on_status(&message, now)?;
        }
        Ok(())
    }

    /// Rejected messages and segments: damaged, forged, repeated, of unknown senders, inconsistent,
    /// requests that are too large or too many, and connections without the token.
    #[must_use]
    pub fn rejected(&self) -> u64 {
        let segments = self.workers.values().map(|worker| worker.receiver.rejected());
        let unproven = self.requests.dropped() + self.link.refused();
        self.rejected + unproven + segments.sum::<u64>()
    }

    /// Passes the host's policy version to its policy sender, which sends the next one.
    fn confirm_policy(&mut self, channel: u64, version: u64) -> anyhow::Result<()> {
        let name = format!("dmprl/{}/policies/{channel:016x}", self.facts.run_id);
        let Some(channel) = self.channels.get_mut(&channel) else { return Ok(()) };
        let sender = match &channel.policies {
            Some(sender) => sender,
            None => {
                let sender = self.link.sender(name, Urgency::Policies)?;
                let sender = SealedSender::new(sender, channel.session.as_ref(), "policies");
                let sender = PolicySender::start(sender)?;
                if let Some((version, message)) = &self.policy {
                    sender.offer(*version, message);
                }
                channel.policies.insert(sender)
            }
        };
        sender.confirm(version);
        Ok(())
    }

    /// Finds the host by the channel in the message's name. The message may still be forged.
    fn host(&mut self, message: &Message) -> Option<&mut Host> {
        let channel = u64::from_str_radix(message.last_name(), 16).ok()?;
        self.registry.by_channel(channel)
    }

    fn on_presence(&mut self, message: &Message, now: Instant) {
        let is_present = message.is_arrival();
        let Some(host) = self.host(message) else { return };
        (host.is_present, host.last_heard) = (is_present, now);
        if !is_present {
            let name = host.name.escape_debug().to_string();
            self.events.push(GatewayEvent::Notice(format!("host {name} is out of reach")));
        }
    }

    fn receive_segments(&mut self, message: &Message, now: Instant) {
        let Some(host) = self.host(message) else {
            let is_old = now.duration_since(self.channels_changed) < OLD_CHANNELS_TOLERATED;
            self.rejected += u64::from(!is_old);
            return;
        };
        let places = host.lease.first as usize..(host.lease.first + host.workers) as usize;
        let channel = host.channel;
        let Self { workers, buffer, rejected, channels, registry, .. } = self;
        let bytes = message.bytes();
        let opened = channels.get_mut(&channel).and_then(|channel| channel.segments.open(&bytes));
        let Some(opened) = opened else {
            *rejected += 1;
            return;
        };
        if let Some(host) = registry.by_channel(channel) {
            (host.last_heard, host.is_present) = (now, true);
        }
        let read = wire::read_batch(opened, buffer, |range, segment| {
            let index = Some(range.worker as usize).filter(|index| places.contains(index));
            match (index.and_then(|index| workers.get_mut(&index)), segment) {
                (Some(worker), None) => worker.receiver.begin(range),
                (Some(worker), Some(segment)) => worker.receiver.receive(range, segment),
                (None, _) => *rejected += 1,
            }
        });
        *rejected += u64::from(read.is_err());
    }

    fn on_status(&mut self, message: &Message, now: Instant) -> anyhow::Result<()> {
        let Some(channel) = self.host(message).map(|host| host.channel) else { return Ok(()) };
        let bytes = message.bytes();
        let opener = self.channels.get_mut(&channel).map(|channel| &mut channel.status);
        let opened = opener.and_then(|opener| opener.open(&bytes));
        let read = opened.and_then(|bytes| serde_json::from_slice::<HostStatus>(bytes).ok());
        let (Some(mut status), Some(host)) = (read, self.registry.by_channel(channel)) else {
            self.rejected += 1;
            return Ok(());
        };
        host.last_heard = now;
        let name = host.name.clone();
        if let Some(before) = &host.status {
            status.no_less_than(before);
        }
        // After a takeover, start to count from the host's current state.
        let before = host.status.replace(status.clone());
        let before = before.unwrap_or_else(|| match host.counted_before {
            true => status.clone(),
            false => HostStatus::default(),
        });
        self.confirm_policy(channel, status.policy_version)?;
        let sent = status.sent.since(&before.sent);
        if sent != Sent::default() {
            self.events.push(GatewayEvent::Sent(sent));
        }
        let count = status.env_failures.saturating_sub(before.env_failures);
        if count > 0 {
            self.events.push(GatewayEvent::EnvFailures { count, host: name.clone() });
        }
        if status.leaves {
            self.release(channel, now)?;
            let notice = format!("host {} has left", name.escape_debug());
            self.events.push(GatewayEvent::Notice(notice));
        }
        Ok(())
    }

    /// Confirms the departure of a host and frees its places.
    fn release(&mut self, channel: u64, now: Instant) -> anyhow::Result<()> {
        let workers = self.registry.remove(channel).map_or(0, |host| host.workers);
        if let Some(mut channel) = self.channels.remove(&channel) {
            let none = vec![LinkAck::default(); workers as usize];
            channel.acks.send(wire::write_acks(RunState::Left, &none))?;
        }
        self.channels_changed = now;
        Ok(())
    }

    /// Attaches to the queues of workers that have arrived.
    fn attach_queues(&mut self, now: Instant) -> anyhow::Result<()> {
        if now.duration_since(self.attach_tried) < ATTACH_INTERVAL {
            return Ok(());
        }
        self.attach_tried = now;
        for worker in self.workers.values_mut().filter(|worker| worker.queue.is_none()) {
            match attach_queue(&self.domain, &self.plan, worker.index) {
                Ok(queue) => worker.queue = Some(queue),
                Err(error @ TransportError::Incompatible { .. }) => return Err(error.into()),
                // The learner is being replaced, or the queue of a killed gateway is not free yet.
                Err(_) => {}
            }
        }
        Ok(())
    }

    fn offer_segments(&mut self) -> anyhow::Result<()> {
        for worker in self.workers.values_mut() {
            if let Some(queue) = &mut worker.queue {
                worker.receiver.offer(queue)?;
            }
        }
        Ok(())
    }

    fn take_policy(&mut self) -> anyhow::Result<()> {
        match self.policies.newest(&mut self.snapshot) {
            Ok(true) => {
                let version = self.snapshot.version;
                let message = Arc::new(wire::write_snapshot(&self.snapshot));
                let channels = self.channels.values();
                for sender in channels.filter_map(|channel| channel.policies.as_ref()) {
                    sender.offer(version, &message);
                }
                self.policy = Some((version, message));
            }
            Ok(false) => {}
            // The snapshot was damaged; another one follows soon.
            Err(TransportError::Snapshot(error)) => {
                let notice = format!("rejected a policy snapshot: {error}");
                self.events.push(GatewayEvent::Notice(notice));
            }
            Err(error) => return Err(error.into()),
        }
        Ok(())
    }
}
