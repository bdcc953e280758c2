//! The learner's place, taken by a thread that only takes segments, checks them and counts.
//!
//! Between two measurements it takes nothing: the workers' queues fill and the workers sleep, which
//! leaves the machine to whatever is measured next.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_shared::segment::{Expected, HINDSIGHT, Rejection, Segment, SegmentHeader, check};
use dmprl_shared::transport::delivery::Inbox;
use dmprl_shared::transport::shared_memory::LearnerEnd;
use dmprl_shared::transport::{AcknowledgementPublisher, ParameterPublisher, SegmentReceiver};
use rustix::time::{ClockId, clock_gettime};

use super::child::LineChild;
use super::nap::Nap;
use super::watch::Watch;
use crate::control::Report;
use crate::terminal::say;

/// Between two cleanings of what dead workers left.
const MAINTENANCE_INTERVAL: Duration = Duration::from_millis(250);
/// Between two acknowledgements, as the learner's.
const ACKNOWLEDGEMENT_INTERVAL: Duration = Duration::from_millis(10);
/// Between two looks for new workers that have no policy yet, while workers start.
const GREETING_INTERVAL: Duration = Duration::from_millis(5);
/// Between two looks for the first segments.
const FIRST_LOOK: Duration = Duration::from_micros(50);
/// Taken before the clock starts: the stale segments of the full queues, and the workers' way back
/// to their pace.
const SETTLE: Duration = Duration::from_millis(100);

/// How late a worker's death may be seen.
const ANSWER_LOOK: Duration = Duration::from_millis(20);

/// What the sink is asked for.
#[derive(Debug, Clone, Copy)]
pub(super) enum Request {
    /// Take segments until each worker has delivered one.
    FirstOfEach,
    /// Take segments, and count those of so much time.
    Measure(Duration, From),
}

/// Whose segments are taken.
#[derive(Debug, Clone, Copy)]
pub(super) enum From {
    /// Each worker's in turn.
    All,
    /// The first worker's; the others sleep once their queues are full.
    First,
}

/// What the sink answers.
#[derive(Debug)]
pub(super) enum Answer {
    /// When the first segment of each worker came.
    FirstOfEach(Vec<Instant>),
    /// What was taken.
    Measured(Window),
}

/// What came in during one measurement.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Window {
    /// Sound segments taken.
    pub(super) segments: u64,
    /// Environment steps in them.
    pub(super) env_steps: u64,
    /// Its length [s].
    pub(super) seconds: f64,
    /// Processor time of the sink itself [s].
    pub(super) cpu_s: f64,
}

/// Segments that should not be, over all measurements.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Discrepancies {
    /// Refused for what they hold, or come twice.
    pub(super) rejected: u64,
    /// Of these, come twice.
    pub(super) duplicate: u64,
    /// Missing in their worker's sequence.
    pub(super) lost: u64,
    /// What came in all, refused or not: no discrepancy, but what others are found by.
    pub(super) received: u64,
}

/// The sink's thread. Dropped, it is stopped and waited for.
pub(super) struct Sink {
    requests: Option<Sender<Request>>,
    answers: Receiver<anyhow::Result<(Answer, Discrepancies)>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Sink {
    /// Begins; nothing is taken before the first request.
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
            nap: Nap::new(queue_segments * expected.worker_count as usize),
            nap_of_first: Nap::new(queue_segments),
        };
        let thread = thread::spawn(move || taker.serve(&asked, &sender));
        Self { requests: Some(requests), answers, stop, thread: Some(thread) }
    }

    /// Asks, and looks after the workers until the answer is there.
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
                Err(RecvTimeoutError::Disconnected) => bail!("the sink has ended"),
                Err(RecvTimeoutError::Timeout) if Instant::now() >= deadline => {
                    bail!("{request:?}: the workers delivered too little within {limit:?}")
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }

    fn ask(&self, request: Request) {
        // A thread that has ended has said why, and the next look at the answers shows it.
        let _ = self.requests.as_ref().map(|requests| requests.send(request));
    }
}

impl Drop for Sink {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.requests = None;
        // A panic of the thread was reported where it happened.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Shows the user what a worker warns of.
pub(super) fn show_warning(name: &str, line: &str) {
    if let Ok(Report::Warning { message }) = serde_json::from_str(line) {
        say(&format!("{name}: {message}"));
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
    nap: Nap,
    nap_of_first: Nap,
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
                    // A worker id out of range was refused, and belongs to nobody.
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

    /// What is taken in so much time, and how much time it really was.
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

    /// Takes the next segment and does what a learner does first: check it and follow its worker's
    /// sequence. One that is refused, or a copy of steps that were counted, counts no steps.
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

    /// A log that is full is emptied, as by a checkpoint.
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
