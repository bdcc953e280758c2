//! Measures the cost of a segment in each part of the system, and of an update in the learner.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, ensure};
use dmprl_learner::learner::Learner;
use dmprl_run::Watch;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::segment::Segment;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::{LogIdentity, SegmentLog};

use super::feed::FeedPlan;
use crate::learner::{STEPS, Timed, fill, timed};
use crate::statistics::median;
use crate::synthetic_segments::{RUN_ID, SyntheticSegments};
use crate::workers::{BenchRun, Workers};

/// Number of measurements of each cost. A worker's cost is their median.
const ROUNDS: u32 = 5;
/// Maximum number of attempts. A measurement is repeated if no segment arrived, as on a busy
/// machine.
const TRIES_MAX: u32 = 20 * ROUNDS;
/// Queue length in segments per environment: enough that the receiver's sleep does not block
/// workers.
const QUEUED_SEGMENTS: usize = 4;
/// Number of different segments to insert: more than fit into the processor's caches.
const POOL_SEGMENTS: usize = 8_192;
/// Segments between two readings of the clock, and between two acknowledgements.
const BATCH_SEGMENTS: usize = 256;
/// Capacity of the log, which is cleared like after a checkpoint to limit its size on disk.
const LOG_BYTES_MAX: u64 = 256 << 20;

/// Cost of a worker.
#[derive(Debug, Clone)]
pub(super) struct WorkerCost {
    /// Processor time per segment [s].
    pub(super) cpu_s: f64,
    /// Environment steps per segment.
    pub(super) steps_per_segment: f64,
    /// Environment spec, as reported by the worker.
    pub(super) spec: EnvSpec,
}

/// Measures real workers while their segments are received as fast as they arrive.
pub(super) fn worker(
    program: PathBuf,
    venv: PathBuf,
    config: &ExperimentConfig,
    watch: &Watch,
    duration: Duration,
) -> anyhow::Result<WorkerCost> {
    let mut config = config.clone();
    config.actors.queue_segments = QUEUED_SEGMENTS * config.actors.envs_per_worker;
    let run = BenchRun::new(program, venv, &config)?;
    let mut workers = Workers::start(&run, watch)?;
    let (mut cpu_s, mut steps) = (Vec::new(), Vec::new());
    for _ in 0..TRIES_MAX {
        let (round, window) = workers.measure(watch, duration / ROUNDS)?;
        if window.segments == 0 {
            continue;
        }
        let segments = window.segments as f64;
        let cores =
            round.cores.context("the system does not report the workers' processor time")?;
        cpu_s.push(cores * window.seconds / segments);
        steps.push(window.env_steps as f64 / segments);
        if cpu_s.len() == ROUNDS as usize {
            break;
        }
    }
    ensure!(!cpu_s.is_empty(), "the workers delivered nothing in {TRIES_MAX} rounds");
    let median_of = |values: &[f64]| median(values).context("no round");
    Ok(WorkerCost {
        cpu_s: median_of(&cpu_s)?,
        steps_per_segment: median_of(&steps)?,
        spec: workers.spec.clone(),
    })
}

/// Processor time per segment of ingest without transport: check, settle, insert.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct InsertCost {
    /// At delivery level `memory` [s].
    pub(super) memory_s: f64,
    /// Additional cost of level `log` [s].
    pub(super) log_s: f64,
}

/// Measures insertion into a full replay, with as many workers as the feed has.
pub(super) fn insert(
    feed: &FeedPlan<'_>,
    folder: &Path,
    duration: Duration,
) -> anyhow::Result<InsertCost> {
    let mut learner = feed.learner()?;
    let mut pool = SegmentPool::new(&learner, feed.workers);
    while learner.replay.len() < learner.replay.capacity() {
        pool.insert(&mut learner)?;
    }
    let memory = timed(duration, || pool.insert(&mut learner))?;
    let (hash, layout) = (learner.policy().architecture_hash(), learner.policy().layout());
    let path = folder.join("segments.log");
    let identity = LogIdentity { run_id: RUN_ID, architecture_hash: hash };
    learner.inbox.log_to(SegmentLog::open(&path, identity, layout, LOG_BYTES_MAX)?);
    let log = timed(duration, || {
        pool.insert(&mut learner)?;
        learner.inbox.acknowledge()?;
        if learner.inbox.logged() >= LOG_BYTES_MAX / 2 {
            learner.inbox.checkpointed(learner.inbox.logged())?;
        }
        Ok(())
    })?;
    let [memory_s, with_log_s] = [memory, log].map(|timed| timed.over(BATCH_SEGMENTS as f64).cpu_s);
    Ok(InsertCost { memory_s, log_s: (with_log_s - memory_s).max(0.0) })
}

/// Segments of all workers, inserted repeatedly with increasing sequence numbers.
struct SegmentPool {
    segments: Vec<Segment>,
    per_worker: u64,
    next: usize,
}

impl SegmentPool {
    fn new(learner: &Learner, workers: usize) -> Self {
        let (layout, hash) = (learner.policy().layout(), learner.policy().architecture_hash());
        let per_worker = POOL_SEGMENTS.div_ceil(workers);
        let mut synthetic_segments: Vec<_> = (0..workers)
            .map(|worker| SyntheticSegments::with_hash(layout, worker as u32, hash))
            .collect();
        let rounds = (0..per_worker).flat_map(|_| {
            synthetic_segments.iter_mut().map(|it| it.next().clone()).collect::<Vec<_>>()
        });
        Self { segments: rounds.collect(), per_worker: per_worker as u64, next: 0 }
    }

    fn insert(&mut self, learner: &mut Learner) -> anyhow::Result<()> {
        for _ in 0..BATCH_SEGMENTS {
            let segment = &mut self.segments[self.next];
            learner.insert(segment).context("a synthetic segment was rejected")?;
            // The checksum stays valid, because it covers only the block.
            segment.header.sequence += self.per_worker;
            self.next = (self.next + 1) % self.segments.len();
        }
        Ok(())
    }
}

/// Measures the learner's update on a replay full of synthetic segments.
///
/// Returns the minimum over several rounds. With one thread, its wall time is the processor time,
/// which excludes other programs.
pub(super) fn update(
    config: &ExperimentConfig,
    spec: &EnvSpec,
    watch: &Watch,
    duration: Duration,
) -> anyhow::Result<Timed> {
    let mut config = config.clone();
    config.actors.joined_max = 0;
    let threads = config.learner.threads;
    let mut learner = Learner::new(config, spec, RUN_ID)?;
    fill(&mut learner, spec, STEPS)?;
    let mut least = Timed { wall_s: f64::INFINITY, cpu_s: f64::INFINITY };
    for _ in 0..ROUNDS {
        watch.check()?;
        let Timed { wall_s, cpu_s } = timed(duration / ROUNDS, || Ok(learner.update()?))?;
        least.wall_s = least.wall_s.min(if threads == 1 { cpu_s } else { wall_s });
        least.cpu_s = least.cpu_s.min(cpu_s);
    }
    Ok(least)
}
