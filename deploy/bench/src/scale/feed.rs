//! Feeds a real learner with segments from many synthetic workers at full rate.
//!
//! The learner runs the same code as in a run: its session polls all queues, checks and settles
//! segments, inserts them into the replay, acknowledges and cleans up. It never does an update,
//! because its warm-up never ends. The feeders are processes of this program with many workers each
//! (`feeder`).

use std::fs::File;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use dmprl_control::Report;
use dmprl_learner::learner::Learner;
use dmprl_learner::session::{Due, Session, Turn};
use dmprl_run::Watch;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::Policy;
use dmprl_shared::segment::SegmentHeader;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::AcknowledgementPublisher;
use dmprl_shared::transport::delivery::{Sent, Watermark};
use dmprl_shared::transport::shared_memory::{
    Acknowledger, Domain, LearnerEnd, Plan, Publisher, Receiver, serve,
};
use dmprl_supervisor::create_domain;

use super::feeder::SegmentFeederArgs;
use crate::child::{LineChild, resident_bytes};
use crate::drain_receiver::{Discrepancies, show_warning, thread_cpu_s};
use crate::synthetic_segments::RUN_ID;

/// Queue length of a worker: four segments for each of eight environments.
const QUEUE_SEGMENTS: usize = 32;
/// Capacity of an outbox beyond that of its queue, as by default in a run.
const OUTBOX_BEYOND: usize = 1_024;
/// A number of steps that is never reached.
const NEVER: u64 = 1_000_000_000_000;
/// Sleep without work, and the intervals of the learner process.
const IDLE_SLEEP: Duration = Duration::from_micros(100);
const ACKNOWLEDGEMENT_INTERVAL: Duration = Duration::from_millis(10);
const MAINTENANCE_INTERVAL: Duration = Duration::from_millis(250);
/// Interval between checks for dead feeders and for an interrupt.
const CHECK_INTERVAL: Duration = Duration::from_millis(20);
/// Time limit from the start of the processes until each worker has delivered a segment and the
/// replay is full.
const START_TIMEOUT: Duration = Duration::from_secs(300);
/// Time beyond an expected duration until an operation times out.
const SLACK: Duration = Duration::from_secs(60);
/// Time for caches and outboxes to reach a steady state once the replay is full.
const SETTLE: Duration = Duration::from_millis(500);

/// Settings of a feed.
pub(super) struct FeedPlan<'a> {
    /// Path of this program, which also runs the feeders.
    pub(super) program: &'a Path,
    /// Configuration of the learner.
    pub(super) config: &'a ExperimentConfig,
    pub(super) spec: &'a EnvSpec,
    /// Number of synthetic workers.
    pub(super) workers: usize,
    /// Number of processes that run the synthetic workers.
    pub(super) processes: usize,
}

impl FeedPlan<'_> {
    /// Creates a learner that only ingests segments.
    pub(super) fn learner(&self) -> anyhow::Result<Learner> {
        let mut config = self.config.clone();
        config.actors.workers = self.workers;
        config.actors.joined_max = 0;
        config.actors.envs_per_worker = 1;
        config.run.steps = NEVER;
        config.exploration.warm_up_steps = NEVER;
        config.metrics.interval_steps = NEVER;
        config.evaluation.interval_steps = NEVER;
        config.checkpoint.interval_steps = NEVER;
        Ok(Learner::new(config, self.spec, RUN_ID)?)
    }

    /// Returns the size of a segment, header plus block.
    pub(super) fn segment_bytes(&self) -> anyhow::Result<usize> {
        let block_len =
            Policy::new(self.config.policy_description(self.spec))?.layout().block_len();
        Ok(size_of::<SegmentHeader>() + block_len * size_of::<f32>())
    }
}

/// Segments received while the replay was full.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct FeedWindow {
    pub(super) seconds: f64,
    /// Number of segments of each worker.
    pub(super) segments: Vec<u64>,
    /// Processor time of the learner's thread [s].
    pub(super) cpu_s: f64,
    /// Resident memory of this process at the start, in the middle and at the end [bytes].
    pub(super) resident_bytes: [Option<u64>; 3],
}

impl FeedWindow {
    /// Returns the number of segments of all workers.
    pub(super) fn total(&self) -> u64 {
        self.segments.iter().sum()
    }
}

/// A learner and its feeder processes.
pub(super) struct Feed {
    children: Vec<LineChild>,
    session: Session<Receiver, Publisher>,
    acknowledgements: Acknowledger,
    acknowledged_at: Instant,
    maintained_at: Instant,
    checked_at: Instant,
    /// The last field, so that it is removed after its users are dropped.
    _domain: Domain,
}

impl Feed {
    /// Starts all processes; returns when each worker has delivered and the replay is full.
    pub(super) fn start(
        feed: &FeedPlan<'_>,
        token: &str,
        folder: &Path,
        watch: &Watch,
    ) -> anyhow::Result<Self> {
        let learner = feed.learner()?;
        let policy = learner.policy();
        let plan = Plan {
            run_id: RUN_ID,
            architecture_hash: policy.architecture_hash(),
            layout: policy.layout(),
            worker_count: feed.workers,
            queue_segments: QUEUE_SEGMENTS,
            parameters_len: policy.parameters_len(),
        };
        let domain = create_domain(token)?;
        let LearnerEnd { segments, parameters, acknowledgements } = serve(domain.path(), &plan)?;
        let session = Session::start(learner, segments, parameters)?;
        let now = Instant::now();
        let (acknowledged_at, maintained_at, checked_at) = (now, now, now);
        let children = start_feeders(feed, &plan, domain.path(), folder)?;
        let mut feed = Self {
            children,
            session,
            acknowledgements,
            acknowledged_at,
            maintained_at,
            checked_at,
            _domain: domain,
        };
        let is_full = |learner: &Learner| {
            let all = learner.inbox.settled().iter().all(|mark| mark.sequence > 0);
            all && learner.replay.len() == learner.replay.capacity()
        };
        let full = feed.run_until(watch, START_TIMEOUT, is_full)?;
        ensure!(
            full,
            "not every worker delivered, or the replay was not full, within {START_TIMEOUT:?}"
        );
        feed.run_for(watch, SETTLE)?;
        Ok(feed)
    }

    /// Counts the segments received during `duration`.
    pub(super) fn measure(
        &mut self,
        watch: &Watch,
        duration: Duration,
    ) -> anyhow::Result<FeedWindow> {
        let before = self.session.learner.inbox.settled().to_vec();
        let start_bytes = resident_bytes();
        let (start, cpu_s) = (Instant::now(), thread_cpu_s());
        self.run_for(watch, duration / 2)?;
        let middle_bytes = resident_bytes();
        // Continues until a segment arrives: on a busy machine, no feeder may have run yet.
        let received = self.session.learner.counters.received;
        let end = Instant::now() + duration / 2;
        let done =
            |learner: &Learner| learner.counters.received > received && Instant::now() >= end;
        ensure!(
            self.run_until(watch, duration + SLACK, done)?,
            "no segment arrived within {SLACK:?}"
        );
        let (seconds, cpu_s) = (start.elapsed().as_secs_f64(), thread_cpu_s() - cpu_s);
        let increase = |(now, before): (&Watermark, &Watermark)| now.sequence - before.sequence;
        let segments =
            self.session.learner.inbox.settled().iter().zip(&before).map(increase).collect();
        let resident_bytes = [start_bytes, middle_bytes, resident_bytes()];
        Ok(FeedWindow { seconds, segments, cpu_s, resident_bytes })
    }

    /// Returns the processor time of the feeders so far \[s\], if the system reports it.
    pub(super) fn feeders_cpu_s(&self) -> Option<f64> {
        self.children.iter().map(LineChild::cpu_s_of_all_threads).sum()
    }

    /// Stops the feeders, receives the remaining segments and compares their number with the
    /// feeders' reports.
    pub(super) fn finish(mut self, watch: &Watch) -> anyhow::Result<Discrepancies> {
        for child in &mut self.children {
            child.send_line("\"stop\"")?;
        }
        let mut sent = Sent::default();
        for child in &mut self.children {
            while let Some(line) = child.next_line_if_any(watch, SLACK, "the last report")? {
                match serde_json::from_str(&line) {
                    Ok(Report::Sent(more)) => sent += more,
                    Ok(_) => show_warning(child.name(), &line),
                    Err(_) => return Err(child.unexpected_line(&line)),
                }
            }
        }
        // The feeders have exited as requested: do not check on them any more.
        self.children.clear();
        self.drain(watch)?;
        let counters = self.session.learner.counters;
        let duplicate = counters.rejected.duplicate;
        Ok(Discrepancies {
            rejected: counters.rejected.total() + duplicate,
            duplicate,
            // Gaps within a sequence, or segments missing at its end.
            lost: counters.lost.max(sent.sent.saturating_sub(counters.received)),
            received: counters.received,
        })
    }

    /// Receives the remaining segments until all queues are empty, within a time limit.
    fn drain(&mut self, watch: &Watch) -> anyhow::Result<()> {
        let deadline = Instant::now() + SLACK;
        loop {
            let (turn, now) = self.turn()?;
            watch.check()?;
            if turn == Turn::Idle {
                return Ok(());
            }
            ensure!(now < deadline, "the queues were not empty within {SLACK:?}");
        }
    }

    fn run_for(&mut self, watch: &Watch, duration: Duration) -> anyhow::Result<()> {
        let end = Instant::now() + duration;
        self.run_until(watch, duration + SLACK, |_| Instant::now() >= end).map(|_| ())
    }

    /// Runs the learner until `until` returns true. Returns false on timeout.
    fn run_until(
        &mut self,
        watch: &Watch,
        limit: Duration,
        until: impl Fn(&Learner) -> bool,
    ) -> anyhow::Result<bool> {
        let deadline = Instant::now() + limit;
        loop {
            let (_, now) = self.turn()?;
            if until(&self.session.learner) {
                return Ok(true);
            }
            if now.duration_since(self.checked_at) < CHECK_INTERVAL {
                continue;
            }
            self.checked_at = now;
            watch.check()?;
            for child in &mut self.children {
                child.received_lines()?.iter().for_each(|line| show_warning(child.name(), line));
            }
            if now >= deadline {
                return Ok(false);
            }
        }
    }

    /// Runs one turn of the learner's session, and its periodic tasks.
    fn turn(&mut self) -> anyhow::Result<(Turn, Instant)> {
        // The intervals exclude all due work; lost and rejected segments are only counted.
        let mut due = |_: Due, _: &mut Learner| Ok(());
        let turn = self.session.turn(&mut due)?;
        match turn {
            Turn::Worked => {}
            Turn::Idle => std::thread::sleep(IDLE_SLEEP),
            Turn::Finished => bail!("the learner ended unexpectedly"),
        }
        let now = Instant::now();
        let inbox = &mut self.session.learner.inbox;
        let due = now.duration_since(self.acknowledged_at) >= ACKNOWLEDGEMENT_INTERVAL;
        if due || inbox.owes_acknowledgement() {
            self.acknowledgements.acknowledge(inbox.acknowledge()?)?;
            self.acknowledged_at = now;
        }
        if now.duration_since(self.maintained_at) >= MAINTENANCE_INTERVAL {
            self.session.maintain()?;
            self.acknowledgements.maintain()?;
            self.maintained_at = now;
        }
        Ok((turn, now))
    }
}

/// Starts the feeder processes, each with a share of the workers.
fn start_feeders(
    feed: &FeedPlan<'_>,
    plan: &Plan,
    domain: &Path,
    folder: &Path,
) -> anyhow::Result<Vec<LineChild>> {
    let arguments = SegmentFeederArgs::arguments(plan, QUEUE_SEGMENTS + OUTBOX_BEYOND);
    let processes = feed.processes.clamp(1, feed.workers);
    let first_worker = |process: usize| feed.workers * process / processes;
    let start = |process: usize| {
        let name = format!("feeder-{process}-of-{}", feed.workers);
        let path = folder.join(format!("{name}.log"));
        let log = File::create(&path);
        let log = log.with_context(|| format!("cannot make {}", path.display()))?;
        let (first, next) = (first_worker(process), first_worker(process + 1));
        let mut command = Command::new(feed.program);
        command.args(&arguments).arg("--shared-memory").arg(domain);
        command.args(["--first", &first.to_string(), "--count", &(next - first).to_string()]);
        command.stderr(log);
        LineChild::start(name, command, &path)
    };
    (0..processes).map(start).collect()
}
