//! Measures the cost of a segment for each part of the system, and of an update for the learner.

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
use crate::learner::{Timed, fill, timed};
use crate::statistics::median;
use crate::synthetic_segments::{RUN_ID, SyntheticSegments};
use crate::workers::{Stage, Workers};

/// Measurements of each cost. A worker's is their median.
const ROUNDS: u32 = 5;
/// Limit of repetitions. A round is repeated if a busy machine delivered nothing during it.
const TRIES_MAX: u32 = 20 * ROUNDS;
/// Queue length in segments per environment. It keeps the receiver's sleep out of the measurement.
const QUEUED_SEGMENTS: usize = 4;
/// Number of different segments inserted in turn: more than the processor's caches hold.
const POOL_SEGMENTS: usize = 8_192;
/// Segments between two checks of the clock, and between two acknowledgements.
const TOGETHER: usize = 256;
/// A full log is cleared, as after a checkpoint, so that the benchmark does not fill the disk.
const LOG_BYTES_MAX: u64 = 256 << 20;

/// Cost of a run's worker.
#[derive(Debug, Clone)]
pub(super) struct WorkerCost {
    /// Processor time per segment [s].
    pub(super) cpu_s: f64,
    /// Environment steps per segment.
    pub(super) steps_per_segment: f64,
    /// Environment spec that the worker reported.
    pub(super) spec: EnvSpec,
}

/// Measures real workers, whose segments are taken as fast as they arrive.
pub(super) fn worker(
    program: PathBuf,
    venv: PathBuf,
    config: &ExperimentConfig,
    (watch, duration): (&Watch, Duration),
) -> anyhow::Result<WorkerCost> {
    let mut config = config.clone();
    config.actors.queue_segments = QUEUED_SEGMENTS * config.actors.envs_per_worker;
    let stage = Stage::new(program, venv, &config)?;
    let mut workers = Workers::start(&stage, watch)?;
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
    let middle = |values: &[f64]| median(values).context("no round");
    Ok(WorkerCost {
        cpu_s: middle(&cpu_s)?,
        steps_per_segment: middle(&steps)?,
        spec: workers.spec.clone(),
    })
}

/// Processor time of an insertion without transport: checking, settling, storing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct InsertCost {
    /// At delivery level `memory` [s].
    pub(super) memory_s: f64,
    /// Additional cost of level `log` [s].
    pub(super) log_s: f64,
}

/// Measures insertion into a full replay, with as many workers as in the feed.
pub(super) fn insert(
    feed: &FeedPlan<'_>,
    folder: &Path,
    duration: Duration,
) -> anyhow::Result<InsertCost> {
    let mut learner = feed.learner()?;
    let mut pool = Pool::new(&learner, feed.workers);
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
    let [memory_s, with_log_s] = [memory, log].map(|timed| timed.over(TOGETHER as f64).cpu_s);
    Ok(InsertCost { memory_s, log_s: (with_log_s - memory_s).max(0.0) })
}

/// Segments of all workers, inserted in turn and repeatedly, each time with new numbers.
struct Pool {
    segments: Vec<Segment>,
    of_each: u64,
    next: usize,
}

impl Pool {
    fn new(learner: &Learner, workers: usize) -> Self {
        let (layout, hash) = (learner.policy().layout(), learner.policy().architecture_hash());
        let of_each = POOL_SEGMENTS.div_ceil(workers);
        let mut synthetic_segments: Vec<_> =
            (0..workers).map(|worker| SyntheticSegments::of(layout, worker as u32, hash)).collect();
        let rounds = (0..of_each).flat_map(|_| {
            synthetic_segments.iter_mut().map(|it| it.next().clone()).collect::<Vec<_>>()
        });
        Self { segments: rounds.collect(), of_each: of_each as u64, next: 0 }
    }

    fn insert(&mut self, learner: &mut Learner) -> anyhow::Result<()> {
        for _ in 0..TOGETHER {
            let segment = &mut self.segments[self.next];
            learner.insert(segment).context("a synthetic segment was rejected")?;
            // The checksum covers only the block.
            segment.header.sequence += self.of_each;
            self.next = (self.next + 1) % self.segments.len();
        }
        Ok(())
    }
}

/// Measures an update of a run's learner, on a replay full of synthetic segments.
///
/// Returns the minimum over several rounds. On one thread it uses processor time, which does not
/// include the time that other programs take.
pub(super) fn update(
    config: &ExperimentConfig,
    spec: &EnvSpec,
    (watch, duration): (&Watch, Duration),
) -> anyhow::Result<Timed> {
    let mut config = config.clone();
    config.actors.joined_max = 0;
    let threads = config.learner.threads;
    let mut learner = Learner::new(config, spec, RUN_ID)?;
    fill(&mut learner, spec)?;
    let mut least = Timed { wall_s: f64::INFINITY, cpu_s: f64::INFINITY };
    for _ in 0..ROUNDS {
        watch.check()?;
        let Timed { wall_s, cpu_s } = timed(duration / ROUNDS, || Ok(learner.update()?))?;
        least.wall_s = least.wall_s.min(if threads == 1 { cpu_s } else { wall_s });
        least.cpu_s = least.cpu_s.min(cpu_s);
    }
    Ok(least)
}
