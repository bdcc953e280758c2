//! A host's end of the bridge, which acts as the learner for its workers.
//!
//! It takes a segment only if the link has room for it, so that waiting segments stay in the
//! workers' queues and cause back-pressure. It retains the segments in flight until the learner has
//! acknowledged them. A worker receives an acknowledgement only after the learner has given it.

use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::segment::Segment;
use dmprl_shared::transport::delivery::{Mark, Sent};
use dmprl_shared::transport::shared_memory::{LearnerEnd, Plan, serve};
use dmprl_shared::transport::{AcknowledgementPublisher, ParameterPublisher, SegmentReceiver};

use super::lane::Lane;
use super::link::{Ends, Inlet, Link, Outlet, Token, Urgency};
use super::window::Window;
use super::wire::{self, Batch, Course, Held, HostAnswer, HostRequest, HostStatus, HostWelcome};
use crate::control::{Greeting, WorkersNow};

/// Name of the request to join a run.
pub(super) const JOIN: &str = "dmprl/join";
/// Time limit for an answer, which takes one round trip.
const ANSWER_LIMIT: Duration = Duration::from_secs(3);
/// Interval between two requests to join.
const ASK_AGAIN: Duration = Duration::from_millis(500);
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
const ACKNOWLEDGE_INTERVAL: Duration = Duration::from_millis(5);
const MAINTENANCE_INTERVAL: Duration = Duration::from_millis(100);
const STATUS_INTERVAL: Duration = Duration::from_millis(250);
/// Time limit to leave the run, which takes one round trip.
const LEAVE_LIMIT: Duration = Duration::from_secs(2);

/// A host's request to join a run.
#[derive(Debug, Clone)]
pub struct Asking {
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
pub enum Asked {
    /// The host has joined.
    Welcome(Box<HostWelcome>),
    /// No answer, or no room at present.
    Later(String),
    /// Rejected; another request would be rejected too.
    Refused(String),
}

/// Sends one request to join.
///
/// # Errors
/// The session is closed.
pub fn ask(link: &Link, asking: &Asking, held: Option<Held>) -> anyhow::Result<Asked> {
    let Asking { endpoint, token, host, name, workers } = asking;
    let request = HostRequest {
        speaks: Greeting::this(),
        token: token.clone(),
        host: *host,
        name: name.clone(),
        workers: *workers,
        held,
    };
    let question = serde_json::to_vec(&request).context("cannot write a request")?;
    let Some(answer) = link.ask(JOIN, question, ANSWER_LIMIT)? else {
        return Ok(Asked::Later(format!("no learner's host answers at {endpoint}")));
    };
    Ok(match serde_json::from_slice(&answer) {
        Ok(HostAnswer::Welcome(welcome)) => Asked::Welcome(welcome),
        Ok(HostAnswer::Refused { reason, later: true }) => Asked::Later(reason),
        Ok(HostAnswer::Refused { reason, later: false }) => Asked::Refused(reason),
        Err(error) => Asked::Refused(format!("{endpoint} sent an invalid answer: {error}")),
    })
}

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

/// The messages of one seat.
struct Seat {
    segments: Outlet,
    status: Outlet,
    hearings: Inlet,
    policies: Inlet,
    /// Arrival and departure of gateways, and the id of the gateway that assigned this seat.
    gateways: Inlet,
    gateway: u64,
    _token: Token,
}

impl Seat {
    fn take(link: &Link, welcome: &HostWelcome) -> anyhow::Result<Self> {
        let name = |what: &str| format!("dmprl/{}/{what}/{:016x}", welcome.run_id, welcome.seat);
        Ok(Self {
            gateways: link.tokens(&format!("dmprl/{}/gateway/*", welcome.run_id))?,
            gateway: welcome.gateway,
            hearings: link.inlet(&name("hearings"))?,
            policies: link.inlet(&name("policies"))?,
            segments: link.outlet(name("segments"), Urgency::Segments)?,
            status: link.outlet(name("status"), Urgency::First)?,
            _token: link.token(name("hosts"))?,
        })
    }

    /// Returns true if the gateway that assigned the seat is gone, or another has appeared.
    fn is_in_doubt(&self) -> anyhow::Result<bool> {
        let mut doubt = false;
        while let Some(message) = self.gateways.next()? {
            let ours = u64::from_str_radix(message.last_name(), 16) == Ok(self.gateway);
            doubt |= ours != message.has_come();
        }
        Ok(doubt)
    }
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
    asking: Asking,
    /// The places of this host.
    given: Held,
    seat: Option<Seat>,
    end: LearnerEnd,
    lanes: Vec<Lane>,
    marks: Vec<Mark>,
    /// The worker whose turn is next.
    next: usize,
    window: Window,
    segment_bytes: u64,
    segment_steps: usize,
    architecture_hash: u64,
    batch: Batch,
    buffer: Segment,
    version: u64,
    env_steps: u64,
    acked: u64,
    started: Instant,
    heard: Instant,
    /// Set if the gateway may be gone or may have been replaced.
    doubt: bool,
    asked: Option<Instant>,
    acknowledged: Instant,
    maintained: Instant,
    told: Instant,
    tell_now: bool,
    /// Time since which the learner's host does not answer, and the reason.
    away: Option<(Instant, String)>,
    /// Messages that could not be read.
    damaged: u64,
}

impl Relay {
    /// Starts to serve the host's workers; `held` are the places assigned to it before.
    ///
    /// # Errors
    /// The session or the shared memory cannot be opened.
    pub fn start(
        asking: Asking,
        (held, zenoh_file): (Held, Option<&Path>),
        (domain, plan): (&Path, &Plan),
        config: &ExperimentConfig,
    ) -> anyhow::Result<Self> {
        let link = Link::open(Ends::Connect(&asking.endpoint), zenoh_file)?;
        let end = serve(domain, plan)?;
        let capacity = config.delivery.unacknowledged_segments;
        let lane = |index: u32| Lane::new(held.first + index, plan.layout, capacity);
        let buffer = Segment::zeroed(plan.layout);
        let segment_bytes = size_of_val(&buffer.header) + size_of_val(buffer.block.as_slice());
        let now = Instant::now();
        Ok(Self {
            link,
            lanes: (0..asking.workers).map(lane).collect(),
            marks: vec![Mark::default(); asking.workers as usize],
            asking,
            given: held,
            seat: None,
            end,
            next: 0,
            window: Window::new(config.bridge.under_way_bytes_max),
            segment_bytes: segment_bytes as u64,
            segment_steps: plan.layout.segment_steps,
            architecture_hash: plan.architecture_hash,
            batch: Batch::default(),
            buffer,
            version: 0,
            env_steps: 0,
            acked: 0,
            started: now,
            heard: now,
            doubt: false,
            asked: None,
            acknowledged: now,
            maintained: now,
            told: now,
            tell_now: false,
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

    /// Number of segments that the learner has not acknowledged.
    #[must_use]
    pub fn under_way(&self) -> u64 {
        self.lanes.iter().map(|lane| lane.under_way() as u64).sum()
    }

    /// Time since which the learner's host does not answer, and the reason.
    #[must_use]
    pub fn away(&self) -> Option<&(Instant, String)> {
        self.away.as_ref()
    }

    /// Number of damaged messages and invalid segments.
    #[must_use]
    pub fn damaged(&self) -> u64 {
        self.damaged + self.lanes.iter().map(Lane::misfits).sum::<u64>()
    }

    /// Runs one turn: reads messages, takes segments, sends them.
    ///
    /// # Errors
    /// Its places belong to another host now, or the transport has failed permanently.
    pub fn turn(&mut self, counts: &HostCounts) -> anyhow::Result<Turn> {
        let now = Instant::now();
        // First, because messages that end the silence may be waiting after a turn with a full
        // link.
        let course = self.hear(now)?;
        self.stay_in_touch(now)?;
        let sent = self.send(now)?;
        self.take_policy()?;
        if now.duration_since(self.acknowledged) >= ACKNOWLEDGE_INTERVAL {
            self.acknowledged = now;
            self.acknowledge()?;
        }
        if now.duration_since(self.maintained) >= MAINTENANCE_INTERVAL {
            self.maintained = now;
            self.end.segments.maintain()?;
            self.end.parameters.maintain()?;
            self.end.acknowledgements.maintain()?;
        }
        if self.tell_now || now.duration_since(self.told) >= STATUS_INTERVAL {
            (self.told, self.tell_now) = (now, false);
            self.tell(counts, false)?;
        }
        Ok(match course {
            Course::Complete => Turn::Complete,
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
            self.tell(counts, true)?;
            let again = Instant::now() + STATUS_INTERVAL;
            while Instant::now() < again {
                if self.hear(Instant::now())? == Course::Left {
                    return Ok(());
                }
                thread::sleep(ACKNOWLEDGE_INTERVAL);
            }
        }
        Ok(())
    }

    /// Joins again if the gateway is silent: there may be a new one, which does not know this host.
    fn stay_in_touch(&mut self, now: Instant) -> anyhow::Result<()> {
        self.doubt |= self.seat.as_ref().map_or(Ok(false), Seat::is_in_doubt)?;
        let silent = now.duration_since(self.heard) >= SILENCE;
        let silent = self.seat.is_none() || self.doubt || silent;
        let due = self.asked.is_none_or(|asked| now.duration_since(asked) >= ASK_AGAIN);
        if !silent || !due {
            return Ok(());
        }
        let asked = ask(&self.link, &self.asking, Some(self.given))?;
        self.asked = Some(Instant::now());
        match asked {
            Asked::Welcome(welcome) => {
                ensure!(
                    welcome.held == self.given,
                    "expected the places {:?} of its workers, got {:?}: start the bridge again",
                    self.given,
                    welcome.held
                );
                self.seat = Some(Seat::take(&self.link, &welcome)?);
                self.lanes.iter_mut().for_each(Lane::begin_anew);
                self.heard = Instant::now();
                // The first status message tells the gateway that this host listens.
                (self.away, self.doubt, self.tell_now) = (None, false, true);
            }
            Asked::Later(reason) => {
                let since = self.away.as_ref().map_or(now, |(since, _)| *since);
                self.away = Some((since, reason));
            }
            Asked::Refused(reason) => bail!("the learner's host refuses: {reason}"),
        }
        Ok(())
    }

    fn hear(&mut self, now: Instant) -> anyhow::Result<Course> {
        let Some(seat) = &self.seat else { return Ok(Course::On) };
        let mut course = Course::On;
        while let Some(message) = seat.hearings.next()? {
            let (said, hearings) = match wire::read_hearings(&message.bytes()) {
                Ok(read) if read.1.len() == self.lanes.len() => read,
                _ => {
                    self.damaged += 1;
                    continue;
                }
            };
            self.heard = now;
            self.away = None;
            course = said;
            let now_s = now.duration_since(self.started).as_secs_f64();
            let mut segments = 0;
            for (lane, hearing) in self.lanes.iter_mut().zip(&hearings) {
                let acked = lane.hear(hearing, now);
                segments += acked.segments;
                if let Some(round_trip_s) = acked.round_trip_s {
                    self.window.time(round_trip_s, now_s);
                }
            }
            self.acked += segments;
            self.window.acknowledge(segments * self.segment_bytes, now_s);
        }
        if course == Course::Stopped {
            let since = self.away.as_ref().map_or(now, |(since, _)| *since);
            self.away = Some((since, "the run was stopped; it may be resumed".to_owned()));
        }
        Ok(course)
    }

    /// Takes segments from the workers in turn while there is room, and sends them.
    fn send(&mut self, now: Instant) -> anyhow::Result<bool> {
        let Some(seat) = &self.seat else { return Ok(false) };
        // Allows at least one segment of any size in flight; otherwise the run would stop.
        let window = (self.window.bytes() / self.segment_bytes).max(1);
        let together = (TURN_BYTES / self.segment_bytes).max(1);
        let room = window.saturating_sub(self.under_way()).min(together);
        let mut room = usize::try_from(room).unwrap_or(0);
        let count = self.lanes.len();
        let mut sent = false;
        for turn in 0..count {
            let worker = (self.next + turn) % count;
            let lane = &mut self.lanes[worker];
            lane.send(&mut self.batch, &mut room, now);
            for _ in 0..TURN_SEGMENTS.min(room) {
                if !lane.has_room()
                    || !self.end.segments.try_receive_from(worker, &mut self.buffer)?
                {
                    break;
                }
                lane.take(&self.buffer);
                lane.send(&mut self.batch, &mut room, now);
            }
            if self.batch.bytes() >= BATCH_BYTES {
                seat.segments.send(self.batch.take())?;
                sent = true;
            }
        }
        self.next = (self.next + 1) % count.max(1);
        if !self.batch.is_empty() {
            seat.segments.send(self.batch.take())?;
            sent = true;
        }
        Ok(sent)
    }

    fn take_policy(&mut self) -> anyhow::Result<()> {
        let Some(seat) = &self.seat else { return Ok(()) };
        let mut newest = None;
        while let Some(message) = seat.policies.next()? {
            newest = Some(message);
        }
        let Some(message) = newest else { return Ok(()) };
        let snapshot = match wire::read_snapshot(&message.bytes()) {
            Ok(snapshot) if snapshot.architecture_hash == self.architecture_hash => snapshot,
            _ => {
                self.damaged += 1;
                return Ok(());
            }
        };
        if snapshot.version > self.version {
            self.end.parameters.publish(&snapshot)?;
            (self.version, self.env_steps) = (snapshot.version, snapshot.env_steps);
        }
        // The gateway sends the next policy after this one is confirmed.
        self.tell_now = true;
        Ok(())
    }

    fn acknowledge(&mut self) -> anyhow::Result<()> {
        self.marks.clear();
        self.marks.extend(self.lanes.iter().map(Lane::mark));
        Ok(self.end.acknowledgements.acknowledge(&self.marks)?)
    }

    fn tell(&mut self, counts: &HostCounts, leaves: bool) -> anyhow::Result<()> {
        let Some(seat) = &self.seat else { return Ok(()) };
        // Send it after the segments; otherwise some would seem to be missing.
        self.lanes.iter().for_each(|lane| lane.say_how_far(&mut self.batch));
        if !self.batch.is_empty() {
            seat.segments.send(self.batch.take())?;
        }
        let HostCounts { sent, env_failures, workers } = *counts;
        let policy_version = self.version;
        let status = HostStatus { policy_version, sent, env_failures, workers, leaves };
        seat.status.send(serde_json::to_vec(&status).context("cannot write a status")?)
    }
}
