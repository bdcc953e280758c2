//! Stage 3 of 8, delivery: sends a worker's finished segments to the learner.
//!
//! [`Delivery`] keeps each segment in an outbox until the learner has acknowledged it, offers it to
//! the worker's queue, and waits while the queue or the outbox is full. It is also built without
//! Python, because benchmarks send synthetic segments through it.

use std::path::Path;
use std::time::{Duration, Instant};

use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::segment::SegmentHeader;
use dmprl_shared::supervision::{Activity, Command, Report, Supervisor};
use dmprl_shared::transport::delivery::{Acknowledgements, Outbox, Sent, Watermark};
use dmprl_shared::transport::shared_memory::{self, Plan};
use dmprl_shared::transport::{
    AcknowledgementSubscriber, ParameterSubscriber, SendOutcome, TransportError, WorkerEnd,
    WorkerTransport,
};
use thiserror::Error;
use tracing::warn;

/// Maximum wait for a command; a stop request is checked in between.
const COMMAND_WAIT: Duration = Duration::from_millis(100);
/// Pause between two attempts to attach, or between two checks for the first policy.
pub(crate) const ATTACH_PAUSE: Duration = Duration::from_millis(2);
/// Time limit to attach. A learner that is ready answers immediately.
pub(crate) const ATTACH_LIMIT: Duration = Duration::from_secs(30);
/// Pause after the first offer to a full queue; it doubles with each retry.
const FULL_QUEUE_PAUSE: Duration = Duration::from_micros(200);
/// Maximum pause. The segments in the queue keep the learner busy for longer than this.
const FULL_QUEUE_PAUSE_MAX: Duration = Duration::from_millis(3);
/// Interval between two reports of the counts.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);

/// Why a segment was not delivered.
#[derive(Debug, Error)]
pub enum DeliveryError {
    /// A stop was requested while the segment waited.
    #[error("a stop was requested")]
    StopRequested,
    /// The transport failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The worker could not attach in time.
    #[error("worker {index} could not attach to the learner within {ATTACH_LIMIT:?}")]
    Attach {
        /// The worker.
        index: u32,
        /// Failure of the last attempt.
        #[source]
        cause: TransportError,
    },
}

/// Waits for the command to attach, then attaches to that learner. Returns `None` if a stop is
/// requested first. The supervisor limits the time of a start.
///
/// # Errors
/// As [`attach`].
pub fn await_learner(
    supervisor: &dyn Supervisor,
    plan: &Plan,
    index: u32,
) -> Result<Option<shared_memory::WorkerEnd>, DeliveryError> {
    loop {
        if supervisor.stop_requested() {
            return Ok(None);
        }
        supervisor.heartbeat(Activity::Attaching);
        if let Some(Command::Attach { domain }) = supervisor.next_command(COMMAND_WAIT) {
            return attach(supervisor, &domain, plan, index);
        }
    }
}

/// Attaches worker `index` to the learner of a domain. Returns `None` if a stop is requested first.
///
/// # Errors
/// `Transport` if the learner follows another plan; `Attach` if it does not answer in time.
pub fn attach(
    supervisor: &dyn Supervisor,
    domain: &Path,
    plan: &Plan,
    index: u32,
) -> Result<Option<shared_memory::WorkerEnd>, DeliveryError> {
    let deadline = Instant::now() + ATTACH_LIMIT;
    loop {
        supervisor.heartbeat(Activity::Attaching);
        match shared_memory::attach(domain, plan, index as usize) {
            Ok(end) => return Ok(Some(end)),
            Err(error @ TransportError::Incompatible { .. }) => return Err(error.into()),
            Err(cause) if Instant::now() >= deadline => {
                return Err(DeliveryError::Attach { index, cause });
            }
            Err(_) if supervisor.stop_requested() => return Ok(None),
            // The slot of a killed predecessor is free after the learner has cleaned it up.
            Err(_) => std::thread::sleep(ATTACH_PAUSE),
        }
    }
}

/// An event in the delivery of a worker's segments and policies.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DeliveryEvent<'a> {
    /// A segment is finished, but not in the outbox yet.
    Produced {
        /// Its header.
        header: &'a SegmentHeader,
        /// Its block.
        block: &'a [f32],
    },
    /// The learner has acknowledged the segments up to this one; the outbox has dropped them.
    Acknowledged(Watermark),
    /// A newer policy was received.
    PolicyTaken {
        /// Epoch of the learner that published it.
        epoch: u64,
        /// Its version.
        version: u64,
    },
}

/// Called synchronously at each [`DeliveryEvent`].
pub type DeliveryObserver = Box<dyn FnMut(DeliveryEvent<'_>)>;

/// The outbox of an attached worker and its ends of the transport.
pub struct Delivery<'a, T: WorkerTransport> {
    supervisor: &'a dyn Supervisor,
    deadline: Duration,
    end: WorkerEnd<T>,
    outbox: Outbox,
    observer: Option<DeliveryObserver>,
    /// Buffer for the newest acknowledgements.
    acknowledgements: Acknowledgements,
    /// Counts in the last report, and its time.
    reported: Sent,
    reported_at: Instant,
}

impl<'a, T: WorkerTransport> Delivery<'a, T> {
    /// Creates a delivery that has sent nothing. It logs a warning whenever a segment has waited
    /// for another `deadline`.
    pub fn new(
        supervisor: &'a dyn Supervisor,
        deadline: Duration,
        end: WorkerEnd<T>,
        outbox: Outbox,
    ) -> Self {
        Self {
            supervisor,
            deadline,
            end,
            outbox,
            observer: None,
            acknowledgements: Acknowledgements::default(),
            reported: Sent::default(),
            reported_at: Instant::now(),
        }
    }

    /// Sets the function to call at each event.
    pub fn set_observer(&mut self, observer: Option<DeliveryObserver>) {
        self.observer = observer;
    }

    /// The worker's index.
    #[must_use]
    pub fn index(&self) -> u32 {
        self.outbox.worker_id()
    }

    /// Counts of the worker's segments so far.
    #[must_use]
    pub fn sent(&self) -> Sent {
        self.outbox.sent()
    }

    /// Copies the learner's newest snapshot into `snapshot` if it is newer; returns whether it did.
    /// Rejects a damaged snapshot with a warning; another one follows soon.
    ///
    /// # Errors
    /// If the transport fails.
    pub fn take_newest_policy(
        &mut self,
        snapshot: &mut ParameterSnapshot,
    ) -> Result<bool, DeliveryError> {
        let taken = match self.end.parameters.newest(snapshot) {
            Err(TransportError::Snapshot(error)) => {
                self.warn(format!("worker {} rejected a policy snapshot: {error}", self.index()));
                false
            }
            taken => taken?,
        };
        if let Some(observer) = self.observer.as_mut().filter(|_| taken) {
            let (epoch, version) = (self.end.parameters.epoch(), snapshot.version);
            observer(DeliveryEvent::PolicyTaken { epoch, version });
        }
        Ok(taken)
    }

    /// Puts a segment into the outbox and waits until the queue has accepted it. No segment is
    /// dropped: a full queue is the learner's back-pressure on its workers.
    ///
    /// # Errors
    /// `StopRequested` if a stop is requested while the segment waits, or if the transport fails.
    pub fn deliver(&mut self, header: &SegmentHeader, block: &[f32]) -> Result<(), DeliveryError> {
        let mut waiting: Option<(Instant, u32)> = None;
        let mut pause = FULL_QUEUE_PAUSE;
        let mut kept = false;
        if let Some(observer) = &mut self.observer {
            observer(DeliveryEvent::Produced { header, block });
        }
        loop {
            if 2 * self.outbox.len() >= self.outbox.capacity() {
                self.take_acknowledgements()?;
            }
            kept = kept || self.outbox.put(header, block);
            let outcome = self.outbox.offer(&mut self.end.segments)?;
            if kept && outcome == SendOutcome::Delivered {
                return Ok(());
            }
            if self.supervisor.stop_requested() {
                return Err(DeliveryError::StopRequested);
            }
            let (since, warnings) = waiting.get_or_insert_with(|| (Instant::now(), 0));
            if since.elapsed() >= self.deadline * (*warnings + 1) {
                *warnings += 1;
                let seconds = since.elapsed().as_secs();
                let why = match outcome {
                    SendOutcome::Detached => "no learner is attached to its queue",
                    SendOutcome::Full => "its queue is full and the learner does not read from it",
                    SendOutcome::Delivered => "the learner acknowledges none of its segments",
                };
                self.warn(format!("worker {} has waited {seconds} s: {why}", self.index()));
            }
            self.take_acknowledgements()?;
            self.supervisor.heartbeat(Activity::Waiting);
            std::thread::sleep(pause);
            pause = (pause * 2).min(FULL_QUEUE_PAUSE_MAX);
        }
    }

    /// Offers the segments in the outbox until the learner has acknowledged all of them, for at
    /// most `limit`.
    ///
    /// # Errors
    /// If the transport fails.
    pub fn hand_over(&mut self, limit: Duration) -> Result<(), DeliveryError> {
        let deadline = Instant::now() + limit;
        loop {
            self.take_acknowledgements()?;
            if self.outbox.is_empty() || self.supervisor.is_gone() || Instant::now() >= deadline {
                return Ok(());
            }
            self.outbox.offer(&mut self.end.segments)?;
            self.supervisor.heartbeat(Activity::Waiting);
            std::thread::sleep(FULL_QUEUE_PAUSE_MAX);
        }
    }

    /// Drops the segments that the learner has acknowledged.
    fn take_acknowledgements(&mut self) -> Result<(), DeliveryError> {
        if self.end.acknowledgements.newest(&mut self.acknowledgements)? {
            let before = self.outbox.sent().acked;
            self.outbox.acknowledge(&self.acknowledgements);
            let sequence = self.outbox.sent().acked;
            if let Some(observer) = self.observer.as_mut().filter(|_| sequence > before) {
                let incarnation = self.outbox.incarnation();
                observer(DeliveryEvent::Acknowledged(Watermark { incarnation, sequence }));
            }
        }
        self.supervisor.note_unacknowledged(self.outbox.len());
        Ok(())
    }

    /// Reports the counts if the last report is a second old; returns whether it did.
    ///
    /// # Errors
    /// If the transport fails.
    pub fn report_in_time(&mut self) -> Result<bool, DeliveryError> {
        let due = self.reported_at.elapsed() >= REPORT_INTERVAL;
        if due {
            self.report()?;
        }
        Ok(due)
    }

    /// Reports the counts since the last report.
    ///
    /// # Errors
    /// If the transport fails.
    pub fn report(&mut self) -> Result<(), DeliveryError> {
        self.take_acknowledgements()?;
        let sent = self.outbox.sent();
        // If the supervisor is gone, a stop is requested, which ends the loop.
        let _ = self.supervisor.report(&Report::Sent(sent.since(&self.reported)));
        (self.reported, self.reported_at) = (sent, Instant::now());
        Ok(())
    }

    fn warn(&self, message: String) {
        warn!("{message}");
        self.supervisor.warn(message);
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::segment::{Segment, SegmentLayout};
    use dmprl_shared::supervision::FakeSupervisor;
    use dmprl_shared::transport::in_process::{
        Acknowledger, InProcess, Receiver, acknowledgement_channel, parameter_channel,
        segment_queues,
    };
    use dmprl_shared::transport::{AcknowledgementPublisher, SegmentReceiver};

    use super::*;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 1, observation_len: 1, action_len: 1 };
    const QUEUE_SEGMENTS: usize = 2;
    const OUTBOX_SEGMENTS: usize = 4;

    fn delivery(
        supervisor: &FakeSupervisor,
        deadline: Duration,
    ) -> (Delivery<'_, InProcess>, Receiver, Acknowledger) {
        let (mut senders, receiver) = segment_queues(1, QUEUE_SEGMENTS, LAYOUT);
        let (_, parameters) = parameter_channel(0);
        let (acknowledger, acknowledgements) = acknowledgement_channel(1);
        let end = WorkerEnd { segments: senders.remove(0), parameters, acknowledgements };
        let outbox = Outbox::new(LAYOUT, OUTBOX_SEGMENTS, 0, 0);
        (Delivery::new(supervisor, deadline, end, outbox), receiver, acknowledger)
    }

    fn deliver(to: &mut Delivery<'_, InProcess>, sequence: u64) -> Result<(), DeliveryError> {
        let segment = Segment::zeroed(LAYOUT);
        to.deliver(&SegmentHeader { sequence, ..SegmentHeader::default() }, &segment.block)
    }

    #[test]
    fn a_segment_that_waits_for_a_full_queue_is_kept_and_causes_a_warning() {
        let supervisor =
            FakeSupervisor::stopping_on(|report| matches!(report, Report::Warning { .. }));
        let (mut delivery, _receiver, _) = delivery(&supervisor, Duration::from_millis(2));
        (1..=2).for_each(|sequence| deliver(&mut delivery, sequence).unwrap());
        let refused = deliver(&mut delivery, 3).unwrap_err();
        assert!(matches!(refused, DeliveryError::StopRequested), "{refused}");
        let warnings = supervisor.warnings();
        assert_eq!(warnings.len(), 1, "{warnings:?}");
        assert!(warnings[0].contains("its queue is full"));
        assert!(supervisor.heartbeats().iter().all(|doing| *doing == Activity::Waiting));
        let sent = delivery.sent();
        assert_eq!((sent.produced, sent.sent, sent.acked), (3, 2, 0));
    }

    #[test]
    fn a_full_outbox_waits_for_the_learners_acknowledgement() {
        let supervisor = FakeSupervisor::default();
        let (mut delivery, mut receiver, mut acknowledger) =
            delivery(&supervisor, Duration::from_secs(60));
        let mut segment = Segment::default();
        for sequence in 1..=OUTBOX_SEGMENTS as u64 {
            deliver(&mut delivery, sequence).unwrap();
            assert!(receiver.try_receive(&mut segment).unwrap());
        }
        acknowledger.acknowledge(&[Watermark { incarnation: 0, sequence: 3 }]).unwrap();
        deliver(&mut delivery, 5).unwrap();
        assert_eq!(delivery.sent().acked, 3);
        assert_eq!(supervisor.unacknowledged(), 1, "before the fifth");
        assert_eq!(supervisor.heartbeats(), [], "nothing had to wait");
    }

    #[test]
    fn an_observer_sees_segments_before_they_are_sent_and_each_new_acknowledgement() {
        let supervisor = FakeSupervisor::default();
        let (mut delivery, _receiver, mut acknowledger) =
            delivery(&supervisor, Duration::from_secs(60));
        let (events, seen) = std::sync::mpsc::channel();
        delivery.set_observer(Some(Box::new(move |event| {
            let sequence = match event {
                DeliveryEvent::Produced { header, .. } => Ok(header.sequence),
                DeliveryEvent::Acknowledged(mark) => Err(mark.sequence),
                DeliveryEvent::PolicyTaken { .. } => unreachable!("none was published"),
            };
            events.send(sequence).unwrap();
        })));
        deliver(&mut delivery, 1).unwrap();
        acknowledger.acknowledge(&[Watermark { incarnation: 0, sequence: 1 }]).unwrap();
        delivery.report().unwrap();
        delivery.report().unwrap();
        assert_eq!(seen.try_iter().collect::<Vec<_>>(), [Ok(1), Err(1)]);
        let sent = |produced, sent, acked| Report::Sent(Sent { produced, sent, resent: 0, acked });
        assert_eq!(supervisor.reports(), [sent(1, 1, 1), sent(0, 0, 0)]);
    }
}
