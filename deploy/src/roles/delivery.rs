//! A worker's side of the transport: attaches, keeps and offers segments, waits where it must.

use std::path::Path;
use std::time::{Duration, Instant};

#[cfg(feature = "python")]
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::segment::SegmentHeader;
#[cfg(feature = "python")]
use dmprl_shared::transport::ParameterSubscriber;
use dmprl_shared::transport::delivery::{Acknowledgements, Mark, Outbox, Sent};
use dmprl_shared::transport::shared_memory::{Plan, WorkerEnd, attach};
use dmprl_shared::transport::{SendOutcome, TransportError};

use super::ControlPipe;
use crate::control::{Doing, Report};
use crate::journal::{Entry, Journal, Piece};

/// Sleep between two tries to attach, or looks for the first policy.
pub const ATTACH: Duration = Duration::from_millis(2);
/// A learner that is ready answers at once; longer means that it is gone.
pub const ATTACH_LIMIT: Duration = Duration::from_secs(30);
/// Sleep after the first offer of a segment to a full queue; doubles with each further one,
const FULL_QUEUE: Duration = Duration::from_micros(200);
/// up to this: a worker waits for milliseconds often, for longer at little cost. The segments that
/// still wait in the queue keep the learner busy for more.
const FULL_QUEUE_MAX: Duration = Duration::from_millis(3);
/// Between two reports of what was sent.
#[cfg(feature = "python")]
const REPORT_INTERVAL: Duration = Duration::from_secs(1);

/// Attaches to the learner of a domain; none if a stop is asked for.
pub fn attach_within(
    control: &ControlPipe,
    (domain, plan): (&Path, &Plan),
    index: u32,
) -> anyhow::Result<Option<WorkerEnd>> {
    let deadline = Instant::now() + ATTACH_LIMIT;
    loop {
        control.beat(Doing::Attaching);
        match attach(domain, plan, index as usize) {
            Ok(end) => return Ok(Some(end)),
            Err(error @ TransportError::Incompatible { .. }) => return Err(error.into()),
            Err(error) if Instant::now() >= deadline => {
                return Err(anyhow::Error::from(error).context(format!(
                    "worker {index} could not attach to the learner within {ATTACH_LIMIT:?}"
                )));
            }
            Err(_) if control.stop_requested() => return Ok(None),
            // The place of a killed predecessor is freed by the learner, a few times a second.
            Err(_) => std::thread::sleep(ATTACH),
        }
    }
}

/// Why a segment was not delivered.
pub enum Stopped {
    /// A stop was asked for.
    Asked,
    /// Something is broken.
    Failed(anyhow::Error),
}

impl From<anyhow::Error> for Stopped {
    fn from(error: anyhow::Error) -> Self {
        Self::Failed(error)
    }
}

/// An attached worker's outbox and what it waits for.
pub struct Delivery<'a> {
    control: &'a ControlPipe,
    deadline: Duration,
    end: WorkerEnd,
    outbox: Outbox,
    /// Where somebody wants to know of everything.
    journal: Option<Journal>,
    /// The newest heard, a buffer.
    acknowledgements: Acknowledgements,
    /// What the supervisor knows of, and since when.
    reported: Sent,
    reported_at: Instant,
}

impl<'a> Delivery<'a> {
    /// Nothing is sent yet. After each `deadline` of waiting in vain there is a warning.
    pub fn new(
        control: &'a ControlPipe,
        deadline: Duration,
        end: WorkerEnd,
        outbox: Outbox,
    ) -> Self {
        Self {
            control,
            deadline,
            end,
            outbox,
            journal: None,
            acknowledgements: Acknowledgements::default(),
            reported: Sent::default(),
            reported_at: Instant::now(),
        }
    }

    /// Notes everything in a journal from now on, if there is one.
    #[cfg(feature = "python")]
    pub fn note_in(&mut self, journal: Option<Journal>) {
        self.journal = journal;
    }

    /// Which worker it is.
    pub fn index(&self) -> u32 {
        self.outbox.worker_id()
    }

    /// Takes over the learner's newest snapshot, if there is a newer one.
    #[cfg(feature = "python")]
    pub fn newest_policy(
        &mut self,
        snapshot: &mut ParameterSnapshot,
    ) -> Result<bool, TransportError> {
        let taken = self.end.parameters.newest(snapshot)?;
        if let Some(journal) = self.journal.as_ref().filter(|_| taken) {
            let epoch = self.end.parameters.epoch();
            journal.note(Entry::Policy { epoch, version: snapshot.version });
        }
        Ok(taken)
    }

    /// Keeps a segment until the learner has acknowledged it, and offers it until a queue has taken
    /// it. Nothing is dropped: a full queue is how the learner slows its workers down.
    pub fn deliver(&mut self, header: &SegmentHeader, block: &[f32]) -> Result<(), Stopped> {
        let mut waiting: Option<(Instant, u32)> = None;
        let mut pause = FULL_QUEUE;
        let mut kept = false;
        if let Some(journal) = &self.journal {
            journal.note(Entry::Produced(Piece::of(header, block)));
        }
        loop {
            if 2 * self.outbox.len() >= self.outbox.capacity() {
                self.hear()?;
            }
            kept = kept || self.outbox.put(header, block);
            let outcome = self.outbox.offer(&mut self.end.segments);
            let outcome = outcome.map_err(|error| Stopped::Failed(error.into()))?;
            if kept && outcome == SendOutcome::Delivered {
                return Ok(());
            }
            if self.control.stop_requested() {
                return Err(Stopped::Asked);
            }
            let (since, told) = waiting.get_or_insert_with(|| (Instant::now(), 0));
            if since.elapsed() >= self.deadline * (*told + 1) {
                *told += 1;
                let seconds = since.elapsed().as_secs();
                let why = match outcome {
                    SendOutcome::Detached => "no learner is attached to its queue",
                    SendOutcome::Full => "the learner takes nothing from its full queue",
                    SendOutcome::Delivered => "the learner acknowledges nothing that it has taken",
                };
                self.warn(format!("worker {} has waited {seconds} s: {why}", self.index()));
            }
            self.hear()?;
            self.control.beat(Doing::Waiting);
            std::thread::sleep(pause);
            pause = (pause * 2).min(FULL_QUEUE_MAX);
        }
    }

    /// Offers what is kept until the learner has acknowledged all of it, for `limit` at most.
    #[cfg(feature = "python")]
    pub fn hand_over(&mut self, limit: Duration) -> anyhow::Result<()> {
        let deadline = Instant::now() + limit;
        loop {
            self.hear()?;
            if self.outbox.is_empty() || self.control.orphaned() || Instant::now() >= deadline {
                return Ok(());
            }
            self.outbox.offer(&mut self.end.segments)?;
            self.control.beat(Doing::Waiting);
            std::thread::sleep(FULL_QUEUE_MAX);
        }
    }

    /// What the worker has done so far.
    #[cfg(feature = "python")]
    pub fn sent(&self) -> Sent {
        self.outbox.sent()
    }

    /// Forgets what the learner has acknowledged.
    fn hear(&mut self) -> anyhow::Result<()> {
        if self.end.acknowledgements.newest(&mut self.acknowledgements)? {
            let before = self.outbox.sent().acked;
            self.outbox.acknowledge(&self.acknowledgements);
            let sequence = self.outbox.sent().acked;
            if let Some(journal) = self.journal.as_ref().filter(|_| sequence > before) {
                let incarnation = self.outbox.incarnation();
                journal.note(Entry::Acknowledged(Mark { incarnation, sequence }));
            }
        }
        self.control.keep(self.outbox.len());
        Ok(())
    }

    /// Tells the supervisor what was sent, once a second; whether it was time to.
    #[cfg(feature = "python")]
    pub fn report_in_time(&mut self) -> anyhow::Result<bool> {
        let due = self.reported_at.elapsed() >= REPORT_INTERVAL;
        if due {
            self.report()?;
        }
        Ok(due)
    }

    /// Tells the supervisor what was sent since the last time.
    pub fn report(&mut self) -> anyhow::Result<()> {
        self.hear()?;
        let sent = self.outbox.sent();
        // A supervisor that is gone is noticed as a stop.
        let _ = self.control.send(&Report::Sent(sent.since(&self.reported)));
        (self.reported, self.reported_at) = (sent, Instant::now());
        Ok(())
    }

    /// Tells the supervisor, who tells the user.
    pub fn warn(&self, message: String) {
        eprintln!("warning: {message}");
        // A supervisor that is gone is noticed as a stop.
        let _ = self.control.send(&Report::Warning { message });
    }
}
