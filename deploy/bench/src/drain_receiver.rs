//! A stand-in for the learner: a thread that only takes, checks and counts segments.
//!
//! It takes nothing between two measurements. The workers' queues fill and the workers sleep, which
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
/// Interval between checks for new workers without a policy, while workers start.
const GREETING_INTERVAL: Duration = Duration::from_millis(5);
/// Interval between checks for the first segments.
const FIRST_LOOK: Duration = Duration::from_micros(50);
/// Time before the clock starts, in which the stale segments of the full queues are taken and the
/// workers return to full speed.
const SETTLE: Duration = Duration::from_millis(100);

/// Maximum delay until a worker's death is noticed.
const ANSWER_LOOK: Duration = Duration::from_millis(20);

/// A request to the receiver.
#[derive(Debug, Clone, Copy)]
pub(super) enum Request {
    /// Take segments until each worker has delivered one.
    FirstOfEach,
    /// Take segments, and count those received during this time.
    Measure(Duration, From),
}

/// Workers whose segments are taken.
#[derive(Debug, Clone, Copy)]
pub(super) enum From {
    /// All workers, in turn.
    All,
    /// The first worker; the others sleep once their queues are full.
    First,
}

/// An answer of the receiver.
#[derive(Debug)]
pub(super) enum Answer {
    /// Time of each worker's first segment.
    FirstOfEach(Vec<Instant>),
    /// Result of the measurement.
    Measured(Window),
}

/// Segments received during one measurement.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Window {
    /// Number of valid segments.
    pub(super) segments: u64,
    /// Number of environment steps in the valid segments.
    pub(super) env_steps: u64,
    /// Duration of the measurement [s].
    pub(super) seconds: f64,
    /// Processor time of the receiver itself [s].
    pub(super) cpu_s: f64,
}

/// Rejected and lost segments over all measurements.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Discrepancies {
    /// Rejected for their content, or duplicate.
    pub(super) rejected: u64,
    /// Duplicate; included in `rejected`.
    pub(super) duplicate: u64,
    /// Missing from their worker's sequence.
    pub(super) lost: u64,
    /// All received segments, rejected or not, for comparison.
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
    /// Starts the thread; it takes nothing before the first request.
    pub(super) fn start(
        end: LearnerEnd,
        expected: Expected,
        queue_segments: usize,
        inbox: Inbox,
    ) -> Self {
        let (requests, asked) = mpsc::channel();
        let (sender, answers) = mpsc::channel();
        let stop = Arc::new(AtomicBool::new(false));
        let taker = Taker {
            end,
            expected,
            stop: Arc::clone(&stop),
            segment: Segment::zeroed(expected.layout),
            inbox,
            discrepancies: Discrepancies::default(),
            maintained: Instant::now(),
            acknowledged: Instant::now(),
            nap: AdaptiveSleep::new(queue_segments * expected.worker_count as usize),
            nap_of_first: AdaptiveSleep::new(queue_segments),
        };
        let thread = thread::spawn(move || taker.serve(&asked, &sender));
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
                let said = child.said()?;
                said.iter().for_each(|line| show_warning(child.name(), line));
            }
            match self.answers.recv_timeout(ANSWER_LOOK) {
                Ok(answer) => return answer.context("the transport failed"),
                Err(RecvTimeoutError::Disconnected) => bail!("the receiver has ended"),
                Err(RecvTimeoutError::Timeout) if Instant::now() >= deadline => {
                    bail!("{request:?}: the workers delivered too little within {limit:?}")
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }

    fn ask(&self, request: Request) {
        // A thread that has exited has sent its error, which the next answer returns.
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

struct Taker {
    end: LearnerEnd,
    expected: Expected,
    stop: Arc<AtomicBool>,
    segment: Segment,
    inbox: Inbox,
    discrepancies: Discrepancies,
    maintained: Instant,
    acknowledged: Instant,
    nap: AdaptiveSleep,
    nap_of_first: AdaptiveSleep,
}

impl Taker {
    fn serve(
        mut self,
        requests: &Receiver<Request>,
        answers: &Sender<anyhow::Result<(Answer, Discrepancies)>>,
    ) {
        loop {
            let answer = match requests.recv_timeout(MAINTENANCE_INTERVAL) {
                Ok(Request::FirstOfEach) => self.first_of_each().map(Answer::FirstOfEach),
                Ok(Request::Measure(duration, from)) => {
                    self.measure(duration, from).map(Answer::Measured)
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
            match self.take(From::All)? {
                Some(header) => {
                    // A worker id out of range was rejected.
                    if let Some(first) = first.get_mut(header.worker_id as usize) {
                        first.get_or_insert_with(Instant::now);
                    }
                }
                None => thread::sleep(FIRST_LOOK),
            }
            if greeted.elapsed() >= GREETING_INTERVAL {
                ParameterPublisher::maintain(&mut self.end.parameters)?;
                greeted = Instant::now();
            }
            self.maintain_in_time()?;
        }
        Ok(first.into_iter().flatten().collect())
    }

    fn measure(&mut self, duration: Duration, from: From) -> anyhow::Result<Window> {
        self.take_for(SETTLE, from)?;
        let cpu_s = thread_cpu_s();
        let taken = self.take_for(duration, from)?;
        Ok(Window { cpu_s: thread_cpu_s() - cpu_s, ..taken })
    }

    /// Takes segments for `duration`; also measures the actual time.
    fn take_for(&mut self, duration: Duration, from: From) -> anyhow::Result<Window> {
        let start = Instant::now();
        let (mut window, mut taken) = (Window::default(), 0);
        while start.elapsed() < duration && !self.stop.load(Ordering::Acquire) {
            match self.take(from)? {
                Some(header) => {
                    window.segments += u64::from(header.steps_len > 0);
                    window.env_steps += u64::from(header.steps_len);
                    taken += 1;
                }
                None => {
                    self.maintain_in_time()?;
                    let nap = match from {
                        From::All => &mut self.nap,
                        From::First => &mut self.nap_of_first,
                    };
                    thread::sleep(nap.next(taken));
                    taken = 0;
                }
            }
        }
        window.seconds = start.elapsed().as_secs_f64();
        Ok(window)
    }

    /// Takes the next segment and does the learner's first steps: it checks the segment and updates
    /// its worker's sequence. Rejected segments and duplicates add no steps.
    fn take(&mut self, from: From) -> anyhow::Result<Option<SegmentHeader>> {
        self.make_room()?;
        let Self { end, segment, .. } = self;
        let received = match from {
            From::All => end.segments.try_receive(segment)?,
            From::First => end.segments.try_receive_from(0, segment)?,
        };
        self.acknowledge_in_time()?;
        if !received {
            return Ok(None);
        }
        self.discrepancies.received += 1;
        let mut header = self.segment.header;
        let sound = check(&header, &self.segment.block, &self.expected);
        match sound.and_then(|()| self.inbox.settle(&header, &self.segment.block)) {
            Ok(lost) => self.discrepancies.lost += lost,
            Err(why) => {
                self.discrepancies.rejected += 1;
                self.discrepancies.duplicate += u64::from(why == Rejection::Duplicate);
                header.steps_len = 0;
            }
        }
        if header.flags & HINDSIGHT != 0 {
            header.steps_len = 0;
        }
        Ok(Some(header))
    }

    fn acknowledge_in_time(&mut self) -> anyhow::Result<()> {
        let early = !self.inbox.owes_acknowledgement();
        if early && self.acknowledged.elapsed() < ACKNOWLEDGEMENT_INTERVAL {
            return Ok(());
        }
        self.acknowledged = Instant::now();
        Ok(self.end.acknowledgements.acknowledge(self.inbox.acknowledge()?)?)
    }

    /// Clears a full log, as after a checkpoint.
    fn make_room(&mut self) -> anyhow::Result<()> {
        if self.inbox.is_full() {
            self.inbox.checkpointed(self.inbox.logged())?;
        } else if !self.inbox.has_room() {
            self.inbox.acknowledge()?;
        }
        Ok(())
    }

    fn maintain_in_time(&mut self) -> anyhow::Result<()> {
        if self.maintained.elapsed() < MAINTENANCE_INTERVAL {
            return Ok(());
        }
        self.maintain()
    }

    fn maintain(&mut self) -> anyhow::Result<()> {
        self.maintained = Instant::now();
        SegmentReceiver::maintain(&mut self.end.segments)?;
        ParameterPublisher::maintain(&mut self.end.parameters)?;
        Ok(self.end.acknowledgements.maintain()?)
    }
}

/// Processor time of the calling thread so far [s].
pub(super) fn thread_cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}
