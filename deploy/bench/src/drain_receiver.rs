//! A stand-in for the learner: a thread that only receives, checks and counts segments.
//!
//! Between two measurements it receives nothing, so the queues fill and the workers sleep. This
//! leaves the machine to the next measurement.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_control::Report;
use dmprl_run::Watch;
use dmprl_shared::segment::{Expected, HINDSIGHT, Rejection, Segment, SegmentHeader, check};
use dmprl_shared::transport::delivery::Inbox;
use dmprl_shared::transport::shared_memory::LearnerEnd;
use dmprl_shared::transport::{AcknowledgementPublisher, ParameterPublisher, SegmentReceiver};
use rustix::time::{ClockId, clock_gettime};
use tracing::info;

use super::adaptive_sleep::AdaptiveSleep;
use super::child::LineChild;

/// Interval between two cleanups of dead workers' segments.
const MAINTENANCE_INTERVAL: Duration = Duration::from_millis(250);
/// Interval between two acknowledgements, as in the learner.
const ACKNOWLEDGEMENT_INTERVAL: Duration = Duration::from_millis(10);
/// Interval between checks for new workers that need the policy, while workers start.
const GREETING_INTERVAL: Duration = Duration::from_millis(5);
/// Interval between checks for each worker's first segment.
const FIRST_POLL_INTERVAL: Duration = Duration::from_micros(50);
/// Time before the measurement starts, in which the full queues are emptied and the workers return
/// to full speed.
const SETTLE: Duration = Duration::from_millis(100);

/// Interval between checks on the workers while waiting for an answer.
const ANSWER_POLL_INTERVAL: Duration = Duration::from_millis(20);

/// A request to the receiver.
#[derive(Debug, Clone, Copy)]
pub(super) enum Request {
    /// Receive segments until each worker has delivered one.
    FirstOfEach,
    /// Receive segments from a source for this time, and count them. It takes longer until at least
    /// `steps_min` steps have come: a rate of zero would say that the workers do nothing, but a
    /// segment of a slow environment, or on a busy machine, takes longer than a short measurement.
    Measure { duration: Duration, source: Source, steps_min: u64 },
}

/// Workers whose segments are received.
#[derive(Debug, Clone, Copy)]
pub(super) enum Source {
    /// All workers, in turn.
    All,
    /// The first worker; the others sleep once their queues are full.
    First,
}

/// The receiver's answer to a request.
#[derive(Debug)]
pub(super) enum Answer {
    /// Time of each worker's first segment.
    FirstOfEach(Vec<Instant>),
    /// Result of the measurement.
    Measured(DrainWindow),
}

/// Segments received during one measurement.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct DrainWindow {
    /// Number of valid segments.
    pub(super) segments: u64,
    /// Number of environment steps in the valid segments.
    pub(super) env_steps: u64,
    /// Duration of the measurement [s].
    pub(super) seconds: f64,
    /// Processor time of the receiver's thread [s].
    pub(super) cpu_s: f64,
}

/// Rejected and lost segments over all measurements.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Discrepancies {
    /// Rejected for their content or as duplicates.
    pub(super) rejected: u64,
    /// Duplicates, which `rejected` includes.
    pub(super) duplicate: u64,
    /// Missing from their worker's sequence.
    pub(super) lost: u64,
    /// All received segments, including rejected ones.
    pub(super) received: u64,
}

/// The receiver's thread, which is stopped and joined on drop.
pub(super) struct DrainReceiver {
    requests: Option<Sender<Request>>,
    answers: Receiver<anyhow::Result<(Answer, Discrepancies)>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl DrainReceiver {
    /// Starts the thread, which receives nothing before the first request.
    pub(super) fn start(
        end: LearnerEnd,
        expected: Expected,
        queue_segments: usize,
        inbox: Inbox,
    ) -> Self {
        let (requests, asked) = mpsc::channel();
        let (sender, answers) = mpsc::channel();
        let stop = Arc::new(AtomicBool::new(false));
        let drain = Drain {
            end,
            expected,
            stop: Arc::clone(&stop),
            segment: Segment::zeroed(expected.layout),
            inbox,
            discrepancies: Discrepancies::default(),
            maintained_at: Instant::now(),
            acknowledged_at: Instant::now(),
            sleep: AdaptiveSleep::new(queue_segments * expected.worker_count as usize),
            sleep_of_first: AdaptiveSleep::new(queue_segments),
        };
        let thread = thread::spawn(move || drain.serve(&asked, &sender));
        Self { requests: Some(requests), answers, stop, thread: Some(thread) }
    }

    /// Sends a request, and checks on the workers until the answer arrives.
    pub(super) fn answer(
        &self,
        request: Request,
        children: &mut [LineChild],
        watch: &Watch,
        limit: Duration,
    ) -> anyhow::Result<(Answer, Discrepancies)> {
        self.ask(request);
        let deadline = Instant::now() + limit;
        loop {
            watch.check()?;
            for child in &mut *children {
                let lines = child.received_lines()?;
                lines.iter().for_each(|line| show_warning(child.name(), line));
            }
            match self.answers.recv_timeout(ANSWER_POLL_INTERVAL) {
                Ok(answer) => return answer.context("the transport failed"),
                Err(RecvTimeoutError::Disconnected) => bail!("the receiver's thread has exited"),
                Err(RecvTimeoutError::Timeout) if Instant::now() >= deadline => {
                    bail!("the workers delivered too few segments within {limit:?}")
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }

    fn ask(&self, request: Request) {
        // If the thread has failed, its error is the next answer.
        let _ = self.requests.as_ref().map(|requests| requests.send(request));
    }
}

impl Drop for DrainReceiver {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.requests = None;
        // A panic of the thread has already been reported.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Shows a worker's warning to the user.
pub(super) fn show_warning(name: &str, line: &str) {
    if let Ok(Report::Warning { message }) = serde_json::from_str(line) {
        info!("{name}: {message}");
    }
}

/// State of the receiver's thread.
struct Drain {
    end: LearnerEnd,
    expected: Expected,
    stop: Arc<AtomicBool>,
    segment: Segment,
    inbox: Inbox,
    discrepancies: Discrepancies,
    maintained_at: Instant,
    acknowledged_at: Instant,
    sleep: AdaptiveSleep,
    sleep_of_first: AdaptiveSleep,
}

impl Drain {
    fn serve(
        mut self,
        requests: &Receiver<Request>,
        answers: &Sender<anyhow::Result<(Answer, Discrepancies)>>,
    ) {
        loop {
            let answer = match requests.recv_timeout(MAINTENANCE_INTERVAL) {
                Ok(Request::FirstOfEach) => self.first_of_each().map(Answer::FirstOfEach),
                Ok(Request::Measure { duration, source, steps_min }) => {
                    self.measure(duration, source, steps_min).map(Answer::Measured)
                }
                Err(RecvTimeoutError::Timeout) => match self.maintain() {
                    Ok(()) => continue,
                    Err(error) => Err(error),
                },
                Err(RecvTimeoutError::Disconnected) => return,
            };
            let failed = answer.is_err();
            let discrepancies = self.discrepancies;
            if answers.send(answer.map(|answer| (answer, discrepancies))).is_err() || failed {
                return;
            }
        }
    }

    fn first_of_each(&mut self) -> anyhow::Result<Vec<Instant>> {
        let mut first: Vec<Option<Instant>> = vec![None; self.expected.worker_count as usize];
        let mut greeted = Instant::now();
        while !self.stop.load(Ordering::Acquire) && first.iter().any(Option::is_none) {
            match self.take(Source::All)? {
                Some(header) => {
                    // A segment with an invalid worker id was rejected.
                    if let Some(first) = first.get_mut(header.worker_id as usize) {
                        first.get_or_insert_with(Instant::now);
                    }
                }
                None => thread::sleep(FIRST_POLL_INTERVAL),
            }
            if greeted.elapsed() >= GREETING_INTERVAL {
                ParameterPublisher::maintain(&mut self.end.parameters)?;
                greeted = Instant::now();
            }
            self.maintain_if_due()?;
        }
        Ok(first.into_iter().flatten().collect())
    }

    fn measure(
        &mut self,
        duration: Duration,
        source: Source,
        steps_min: u64,
    ) -> anyhow::Result<DrainWindow> {
        self.take_for(SETTLE, source, 0)?;
        let cpu_s = thread_cpu_s();
        let taken = self.take_for(duration, source, steps_min)?;
        Ok(DrainWindow { cpu_s: thread_cpu_s() - cpu_s, ..taken })
    }

    /// Receives segments for `duration`, or for longer until there are `steps_min` steps. The
    /// result has the actual time.
    fn take_for(
        &mut self,
        duration: Duration,
        source: Source,
        steps_min: u64,
    ) -> anyhow::Result<DrainWindow> {
        let start = Instant::now();
        let (mut window, mut taken) = (DrainWindow::default(), 0);
        while (start.elapsed() < duration || window.env_steps < steps_min)
            && !self.stop.load(Ordering::Acquire)
        {
            match self.take(source)? {
                Some(header) => {
                    window.segments += u64::from(header.steps_len > 0);
                    window.env_steps += u64::from(header.steps_len);
                    taken += 1;
                }
                None => {
                    self.maintain_if_due()?;
                    let sleep = match source {
                        Source::All => &mut self.sleep,
                        Source::First => &mut self.sleep_of_first,
                    };
                    thread::sleep(sleep.next(taken));
                    taken = 0;
                }
            }
        }
        window.seconds = start.elapsed().as_secs_f64();
        Ok(window)
    }

    /// Receives the next segment, checks it and updates its worker's sequence, as the learner does.
    /// Rejected segments and duplicates count no steps.
    fn take(&mut self, source: Source) -> anyhow::Result<Option<SegmentHeader>> {
        self.make_room()?;
        let Self { end, segment, .. } = self;
        let received = match source {
            Source::All => end.segments.try_receive(segment)?,
            Source::First => end.segments.try_receive_from(0, segment)?,
        };
        self.acknowledge_if_due()?;
        if !received {
            return Ok(None);
        }
        self.discrepancies.received += 1;
        let mut header = self.segment.header;
        let checked = check(&header, &self.segment.block, &self.expected);
        match checked.and_then(|()| self.inbox.settle(&header, &self.segment.block)) {
            Ok(lost) => self.discrepancies.lost += lost,
            Err(rejection) => {
                self.discrepancies.rejected += 1;
                self.discrepancies.duplicate += u64::from(rejection == Rejection::Duplicate);
                header.steps_len = 0;
            }
        }
        if header.flags & HINDSIGHT != 0 {
            header.steps_len = 0;
        }
        Ok(Some(header))
    }

    fn acknowledge_if_due(&mut self) -> anyhow::Result<()> {
        let owed = self.inbox.owes_acknowledgement();
        if !owed && self.acknowledged_at.elapsed() < ACKNOWLEDGEMENT_INTERVAL {
            return Ok(());
        }
        self.acknowledged_at = Instant::now();
        Ok(self.end.acknowledgements.acknowledge(self.inbox.acknowledge()?)?)
    }

    /// Clears a full log, as a checkpoint would.
    fn make_room(&mut self) -> anyhow::Result<()> {
        if self.inbox.is_full() {
            self.inbox.checkpointed(self.inbox.logged())?;
        } else if !self.inbox.has_room() {
            self.inbox.acknowledge()?;
        }
        Ok(())
    }

    fn maintain_if_due(&mut self) -> anyhow::Result<()> {
        if self.maintained_at.elapsed() < MAINTENANCE_INTERVAL {
            return Ok(());
        }
        self.maintain()
    }

    fn maintain(&mut self) -> anyhow::Result<()> {
        self.maintained_at = Instant::now();
        SegmentReceiver::maintain(&mut self.end.segments)?;
        ParameterPublisher::maintain(&mut self.end.parameters)?;
        Ok(self.end.acknowledgements.maintain()?)
    }
}

/// Returns the processor time of the calling thread so far [s].
pub(super) fn thread_cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}
