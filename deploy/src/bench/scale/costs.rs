//! What a segment costs each part of the system, and an update the learner.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, ensure};
use dmprl_learner::learner::Learner;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::segment::Segment;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::SegmentLog;

use super::feed::FeedPlan;
use crate::bench::learner::{Timed, fill, timed};
use crate::bench::made_up::{MadeUp, RUN_ID};
use crate::bench::statistics::median;
use crate::bench::watch::Watch;
use crate::bench::workers::{Stage, Workers};

/// Each cost is measured so often; of a worker's the median counts.
const ROUNDS: u32 = 5;
/// A round too short for a busy machine to deliver anything in is repeated, so often at most.
const TRIES_MAX: u32 = 20 * ROUNDS;
/// Of each environment in a worker's queue: what is measured is the worker, and not the sleep of
/// whoever takes from it.
const QUEUED_SEGMENTS: usize = 4;
/// Segments inserted in turn: more than a cache near the processor holds.
const POOL_SEGMENTS: usize = 8_192;
/// Between two looks at the clock, and acknowledgements.
const TOGETHER: usize = 256;
/// A full log is emptied, as by a checkpoint: a benchmark must not fill the disk.
const LOG_BYTES_MAX: u64 = 256 << 20;

/// What a worker of a run costs.
#[derive(Debug, Clone)]
pub(super) struct WorkerCost {
    /// Processor time for a segment [s].
    pub(super) cpu_s: f64,
    /// Environment steps in one.
    pub(super) steps_per_segment: f64,
    /// What it has told of its environment.
    pub(super) spec: EnvSpec,
}

/// Of real workers, whose segments are taken as fast as they come.
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
        let cores = round.cores.context("the system tells no processor time of the workers")?;
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

/// Processor time of an insertion without any transport: checked, settled, stored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct InsertCost {
    /// At delivery level `memory` [s].
    pub(super) memory_s: f64,
    /// What level `log` adds [s].
    pub(super) log_s: f64,
}

/// Into a full replay, of as many workers as a feed has.
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
    learner.inbox.log_to(SegmentLog::open(&path, (RUN_ID, hash), layout, LOG_BYTES_MAX)?);
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

/// Segments of all workers, in turn, again and again under higher numbers.
struct Pool {
    segments: Vec<Segment>,
    of_each: u64,
    next: usize,
}

impl Pool {
    fn new(learner: &Learner, workers: usize) -> Self {
        let (layout, hash) = (learner.policy().layout(), learner.policy().architecture_hash());
        let of_each = POOL_SEGMENTS.div_ceil(workers);
        let mut made_up: Vec<_> =
            (0..workers).map(|worker| MadeUp::of(layout, worker as u32, hash)).collect();
        let rounds = (0..of_each)
            .flat_map(|_| made_up.iter_mut().map(|it| it.next().clone()).collect::<Vec<_>>());
        Self { segments: rounds.collect(), of_each: of_each as u64, next: 0 }
    }

    fn insert(&mut self, learner: &mut Learner) -> anyhow::Result<()> {
        for _ in 0..TOGETHER {
            let segment = &mut self.segments[self.next];
            learner.insert(segment).context("a made-up segment was refused")?;
            // The checksum is of the block alone.
            segment.header.sequence += self.of_each;
            self.next = (self.next + 1) % self.segments.len();
        }
        Ok(())
    }
}

/// Of a run's learner, on a replay full of made-up segments.
///
/// The least of several rounds, and on one thread its processor time: what other programs on the
/// machine take from it is none of its cost.
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
