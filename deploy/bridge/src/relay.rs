//! A host's end of the bridge, which acts as the learner for its workers.
//!
//! It takes a segment only if the link has room for it, so that waiting segments stay in the
//! workers' queues and cause back-pressure. It retains the segments in flight until the learner has
//! acknowledged them. A worker receives an acknowledgement only after the learner has given it.

mod channel;

use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use dmprl_control::WorkersNow;
use dmprl_shared::segment::Segment;
use dmprl_shared::transport::delivery::{Sent, Watermark};
use dmprl_shared::transport::shared_memory::{LearnerEnd, Plan, serve};
use dmprl_shared::transport::{AcknowledgementPublisher, ParameterPublisher, SegmentReceiver};

use self::channel::Channel;
use super::congestion_window::CongestionWindow;
use super::host_messages::{HostStatus, Lease};
use super::join::{JoinOutcome, JoinSettings, request_join};
use super::link::Link;
use super::link_mode::LinkMode;
use super::link_sender::LinkSender;
use super::wire::{self, Batch, RunState};

/// Interval between two requests to join.
const JOIN_INTERVAL: Duration = Duration::from_millis(500);
/// Silence after which the gateway or the link counts as gone. The gateway sends several messages
/// per second.
const SILENCE: Duration = Duration::from_secs(5);
/// Size at which a batch is sent at once. The link splits messages into pieces of 64 KiB.
const BATCH_BYTES: usize = 60_000;
/// Maximum number of bytes per turn, before messages are read again. Retransmits after a broken
/// link are thus sent piece by piece.
const TURN_BYTES: u64 = 262_144;
/// Maximum number of segments of one worker per turn.
const TURN_SEGMENTS: usize = 16;
const ACK_INTERVAL: Duration = Duration::from_millis(5);
const MAINTENANCE_INTERVAL: Duration = Duration::from_millis(100);
const STATUS_INTERVAL: Duration = Duration::from_millis(250);
/// Time limit to leave the run, which takes one round trip.
const LEAVE_LIMIT: Duration = Duration::from_secs(2);

/// Counts that the host's supervisor has reported.
#[derive(Debug, Clone, Copy, Default)]
pub struct HostCounts {
    /// Segments of its workers.
    pub sent: Sent,
    /// Number of failures of environments.
    pub env_failures: u64,
    /// State of its workers.
    pub workers: WorkersNow,
}

/// Where a relay connects and which workers it serves.
#[derive(Debug)]
pub struct RelaySettings<'a> {
    /// The run to join.
    pub join: JoinSettings,
    /// Places that this host was given when it joined.
    pub lease: Lease,
    /// Zenoh's own configuration file.
    pub zenoh_file: Option<&'a Path>,
    /// This host's shared-memory directory.
    pub domain: &'a Path,
    /// The plan of this host's workers.
    pub plan: &'a Plan,
    /// Maximum number of retained segments of each worker.
    pub segments_max: usize,
    /// Maximum number of bytes in flight.
    pub in_flight_bytes_max: u64,
}

/// Result of a turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Turn {
    /// There may be more to do.
    Worked,
    /// There was nothing to do.
    Idle,
    /// The run is complete.
    Complete,
}

/// The relay of a host.
pub struct Relay {
    link: Link,
    join: JoinSettings,
    /// The places of this host.
    lease: Lease,
    /// Open once the host has joined.
    channel: Option<Channel>,
    learner_end: LearnerEnd,
    /// One for each worker.
    senders: Vec<LinkSender>,
    marks: Vec<Watermark>,
    /// The worker whose turn is next.
    next: usize,
    window: CongestionWindow,
    segment_bytes: u64,
    segment_steps: usize,
    architecture_hash: u64,
    batch: Batch,
    buffer: Segment,
    version: u64,
    env_steps: u64,
    acked: u64,
    started: Instant,
    last_heard: Instant,
    /// Set if the gateway may be gone or may have been replaced.
    in_doubt: bool,
    join_requested: Option<Instant>,
    acks_sent: Instant,
    maintained: Instant,
    status_sent: Instant,
    /// Set if a status is due before the regular interval has passed.
    status_due: bool,
    /// Time since which the learner's host does not answer, and the reason.
    away: Option<(Instant, String)>,
    /// Messages that were damaged, forged or repeated.
    damaged: u64,
}

impl Relay {
    /// Starts to serve the host's workers.
    ///
    /// # Errors
    /// The session or the shared memory cannot be opened.
    pub fn start(settings: RelaySettings<'_>) -> anyhow::Result<Self> {
        let RelaySettings { join, lease, zenoh_file, domain, plan, .. } = settings;
        let link = Link::open(LinkMode::Connect(&join.endpoint), &join.token, zenoh_file)?;
        let learner_end = serve(domain, plan)?;
        let workers = lease.first..lease.first + join.workers;
        let senders =
            workers.map(|index| LinkSender::new(index, plan.layout, settings.segments_max));
        let buffer = Segment::zeroed(plan.layout);
        let segment_bytes = size_of_val(&buffer.header) + size_of_val(buffer.block.as_slice());
        let now = Instant::now();
        Ok(Self {
            link,
            senders: senders.collect(),
            marks: vec![Watermark::default(); join.workers as usize],
            join,
            lease,
            channel: None,
            learner_end,
            next: 0,
            window: CongestionWindow::new(settings.in_flight_bytes_max),
            segment_bytes: segment_bytes as u64,
            segment_steps: plan.layout.segment_steps,
            architecture_hash: plan.architecture_hash,
            batch: Batch::default(),
            buffer,
            version: 0,
            env_steps: 0,
            acked: 0,
            started: now,
            last_heard: now,
            in_doubt: false,
            join_requested: None,
            acks_sent: now,
            maintained: now,
            status_sent: now,
            status_due: false,
            away: Some((now, "no request has been sent yet".to_owned())),
            damaged: 0,
        })
    }

    /// Version of the newest policy that the host's workers have; 0 if none.
    #[must_use]
    pub fn version(&self) -> u64 {
        self.version
    }

    /// Environment steps of the run when that policy was published.
    #[must_use]
    pub fn env_steps(&self) -> u64 {
        self.env_steps
    }

    /// Environment steps per segment.
    #[must_use]
    pub fn segment_steps(&self) -> usize {
        self.segment_steps
    }

    /// Number of segments that the learner has acknowledged.
    #[must_use]
    pub fn acked(&self) -> u64 {
        self.acked
    }

    /// Current limit of bytes in flight.
    #[must_use]
    pub fn window_bytes(&self) -> u64 {
        self.window.bytes()
    }

    /// Number of segments that were sent and that the learner has not acknowledged.
    #[must_use]
    pub fn in_flight(&self) -> u64 {
        self.senders.iter().map(|sender| sender.in_flight() as u64).sum()
    }

    /// Time since which the learner's host does not answer, and the reason.
    #[must_use]
    pub fn away(&self) -> Option<&(Instant, String)> {
        self.away.as_ref()
    }

    /// Number of damaged or forged messages and invalid segments.
    #[must_use]
    pub fn damaged(&self) -> u64 {
        self.damaged + self.senders.iter().map(LinkSender::rejected).sum::<u64>()
    }

    /// Runs one turn: reads messages, takes segments, sends them.
    ///
    /// # Errors
    /// Its places belong to another host now, or the transport has failed permanently.
    pub fn turn(&mut self, counts: &HostCounts) -> anyhow::Result<Turn> {
        let now = Instant::now();
        // First, because messages that end the silence may be waiting after a turn with a full
        // link.
        let state = self.read_acks(now)?;
        self.rejoin_if_silent(now)?;
        let sent = self.send_segments(now)?;
        self.take_policy()?;
        if now.duration_since(self.acks_sent) >= ACK_INTERVAL {
            self.acks_sent = now;
            self.acknowledge()?;
        }
        if now.duration_since(self.maintained) >= MAINTENANCE_INTERVAL {
            self.maintained = now;
            self.learner_end.segments.maintain()?;
            self.learner_end.parameters.maintain()?;
            self.learner_end.acknowledgements.maintain()?;
        }
        if self.status_due || now.duration_since(self.status_sent) >= STATUS_INTERVAL {
            (self.status_sent, self.status_due) = (now, false);
            self.send_status(counts, false)?;
        }
        Ok(match state {
            RunState::Complete => Turn::Complete,
            _ if sent => Turn::Worked,
            _ => Turn::Idle,
        })
    }

    /// Announces the departure until the gateway confirms it: a closing session may lose its last
    /// messages.
    ///
    /// # Errors
    /// The session is closed.
    pub fn leave(&mut self, counts: &HostCounts) -> anyhow::Result<()> {
        let deadline = Instant::now() + LEAVE_LIMIT;
        while self.away.is_none() && Instant::now() < deadline {
            self.send_status(counts, true)?;
            let again = Instant::now() + STATUS_INTERVAL;
            while Instant::now() < again {
                if self.read_acks(Instant::now())? == RunState::Left {
                    return Ok(());
                }
                thread::sleep(ACK_INTERVAL);
            }
        }
        Ok(())
    }

    /// Joins again if the gateway is silent: there may be a new one, which does not know this host.
    fn rejoin_if_silent(&mut self, now: Instant) -> anyhow::Result<()> {
        self.in_doubt |= self.channel.as_ref().map_or(Ok(false), Channel::is_in_doubt)?;
        let silent = now.duration_since(self.last_heard) >= SILENCE;
        let needed = self.channel.is_none() || self.in_doubt || silent;
        let due = self.join_requested.is_none_or(|at| now.duration_since(at) >= JOIN_INTERVAL);
        if !needed || !due {
            return Ok(());
        }
        let outcome = request_join(&self.link, &self.join, Some(self.lease))?;
        self.join_requested = Some(Instant::now());
        match outcome {
            JoinOutcome::Welcome(admission) => {
                let welcome = &admission.welcome;
                ensure!(
                    welcome.lease == self.lease,
                    "expected the places {:?} of its workers, got {:?}: start the bridge again",
                    self.lease,
                    welcome.lease
                );
                self.channel = Some(Channel::open(&self.link, &admission)?);
                self.senders.iter_mut().for_each(LinkSender::begin_retransmit);
                self.last_heard = Instant::now();
                // The first status message tells the gateway that this host listens.
                (self.away, self.in_doubt, self.status_due) = (None, false, true);
            }
            JoinOutcome::Silent => {
                let reason = format!("no learner's host answers at {}", self.join.endpoint);
                self.set_away(now, reason);
            }
            JoinOutcome::Later(reason) => self.set_away(now, reason),
            JoinOutcome::Refused(reason) => bail!("the learner's host refuses: {reason}"),
        }
        Ok(())
    }

    /// Records why the learner's host does not answer, since `now` or the time noted before.
    fn set_away(&mut self, now: Instant, reason: String) {
        let since = self.away.as_ref().map_or(now, |(since, _)| *since);
        self.away = Some((since, reason));
    }

    fn read_acks(&mut self, now: Instant) -> anyhow::Result<RunState> {
        let Some(channel) = &mut self.channel else { return Ok(RunState::Running) };
        let mut state = RunState::Running;
        while let Some(read) = channel.acks.next(|bytes| wire::read_acks(bytes?).ok())? {
            let (newest, acks) = match read {
                Some(read) if read.1.len() == self.senders.len() => read,
                _ => {
                    self.damaged += 1;
                    continue;
                }
            };
            self.last_heard = now;
            self.away = None;
            state = newest;
            let now_s = now.duration_since(self.started).as_secs_f64();
            let mut segments = 0;
            for (sender, ack) in self.senders.iter_mut().zip(&acks) {
                let acked = sender.acknowledge(ack, now);
                segments += acked.segments;
                if let Some(round_trip_s) = acked.round_trip_s {
                    self.window.record_round_trip(round_trip_s, now_s);
                }
            }
            self.acked += segments;
            self.window.acknowledge(segments * self.segment_bytes, now_s);
        }
        if state == RunState::Stopped {
            self.set_away(now, "the run was stopped; it may be resumed".to_owned());
        }
        Ok(state)
    }

    /// Takes segments from the workers in turn while there is room, and sends them.
    fn send_segments(&mut self, now: Instant) -> anyhow::Result<bool> {
        // Allows at least one segment of any size in flight; otherwise the run would stop.
        let window = (self.window.bytes() / self.segment_bytes).max(1);
        let together = (TURN_BYTES / self.segment_bytes).max(1);
        let room = window.saturating_sub(self.in_flight()).min(together);
        let Some(channel) = &mut self.channel else { return Ok(false) };
        let mut room = usize::try_from(room).unwrap_or(0);
        let count = self.senders.len();
        let mut sent = false;
        for turn in 0..count {
            let worker = (self.next + turn) % count;
            let sender = &mut self.senders[worker];
            sender.send(&mut self.batch, &mut room, now);
            for _ in 0..TURN_SEGMENTS.min(room) {
                if !sender.has_room()
                    || !self.learner_end.segments.try_receive_from(worker, &mut self.buffer)?
                {
                    break;
                }
                sender.take(&self.buffer);
                sender.send(&mut self.batch, &mut room, now);
            }
            if self.batch.bytes() >= BATCH_BYTES {
                channel.segments.send(self.batch.take())?;
                sent = true;
            }
        }
        self.next = (self.next + 1) % count.max(1);
        if !self.batch.is_empty() {
            channel.segments.send(self.batch.take())?;
            sent = true;
        }
        Ok(sent)
    }

    fn take_policy(&mut self) -> anyhow::Result<()> {
        let Some(channel) = &mut self.channel else { return Ok(()) };
        let mut newest = None;
        while let Some(read) = channel.policies.next(|bytes| wire::read_snapshot(bytes?).ok())? {
            match read {
                Some(snapshot) if snapshot.architecture_hash == self.architecture_hash => {
                    newest = Some(snapshot);
                }
                _ => self.damaged += 1,
            }
        }
        let Some(snapshot) = newest else { return Ok(()) };
        if snapshot.version > self.version {
            self.learner_end.parameters.publish(&snapshot)?;
            (self.version, self.env_steps) = (snapshot.version, snapshot.env_steps);
        }
        // The gateway sends the next policy after this one is confirmed.
        self.status_due = true;
        Ok(())
    }

    fn acknowledge(&mut self) -> anyhow::Result<()> {
        self.marks.clear();
        self.marks.extend(self.senders.iter().map(LinkSender::mark));
        Ok(self.learner_end.acknowledgements.acknowledge(&self.marks)?)
    }

    fn send_status(&mut self, counts: &HostCounts, leaves: bool) -> anyhow::Result<()> {
        let Some(channel) = &mut self.channel else { return Ok(()) };
        // After the segments: otherwise some would seem to be missing.
        self.senders.iter().for_each(|sender| sender.report_progress(&mut self.batch));
        if !self.batch.is_empty() {
            channel.segments.send(self.batch.take())?;
        }
        let HostCounts { sent, env_failures, workers } = *counts;
        let policy_version = self.version;
        let status = HostStatus { policy_version, sent, env_failures, workers, leaves };
        channel.status.send(serde_json::to_vec(&status).context("cannot write a status")?)
    }
}
