//! `dmprl bench scale`: predicts the throughput of many workers, and measures a learner with 256.
//!
//! ```text
//!   feed (feeder processes ─► real queues ─► session) ─► capacity of ingest
//!   costs: worker, transport, ingest, update ─► model ─► table for 16 to 1 024 workers
//!                                                 └────► check: real runs with 1 to 4 workers
//! ```
//! The simulation (`feed`, `feeder`) measures the capacity of one learner: segments per second,
//! shares of the workers, memory. `costs` measures the cost of a segment in each part, and of an
//! update in the learner. `model` predicts the throughput for other numbers of workers and hosts,
//! and `bench system` measures real systems for comparison.

mod costs;
mod feed;
mod feeder;
mod figures;
mod model;
mod table;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use dmprl_run::Manifest;
use dmprl_run::Progress;
use dmprl_run::{Interrupted, Watch};
use dmprl_shared::config::{ExperimentConfig, Limits};
use dmprl_shared::spec::EnvSpec;

use super::drain_receiver::Discrepancies;
use super::synthetic_segments::Size;
use super::system::{self, SteadyWindow, SystemBench};

pub use feeder::{SegmentFeederArgs, segment_feeder};
pub use figures::Figures;

use feed::{Feed, FeedPlan, FeedWindow};
use figures::{Check, CostFigures, Simulated};
use model::{Costs, Demand, Model, Topology};

/// Settings of the benchmark.
pub struct ScaleBench {
    /// Path of this program, which also runs the other processes.
    pub program: PathBuf,
    /// The resolved configuration of a run. The cost of a worker is measured with
    /// `actors.workers` workers.
    pub config: ExperimentConfig,
    /// Python virtual environment of the workers.
    pub venv: PathBuf,
    /// Number of synthetic workers in the simulation.
    pub synthetic_workers: usize,
    /// Number of processes that run the synthetic workers.
    pub feeders: usize,
    /// Size of the synthetic segments in bytes: one of the sizes of `bench transport`.
    pub segment_bytes: usize,
    /// Duration of the simulation.
    pub duration: Duration,
    /// Duration of the measurement of each cost.
    pub cost_duration: Duration,
    /// Largest real system to compare with the model; all smaller ones are compared too.
    pub check_workers: usize,
    /// Duration of the measurement of each real system.
    pub check_duration: Duration,
    /// Cores of this machine.
    pub cores: usize,
    /// Workers per host in the model.
    pub cores_per_host: usize,
    /// Bandwidth of the network into the learner's host; `None` for unlimited.
    pub link_bytes_per_s: Option<f64>,
}

/// Runs the benchmark; returns `None` if the user interrupted it. Removes all its processes and
/// files.
///
/// # Errors
/// A process cannot be started or dies, or the transport fails.
pub fn scale(bench: &ScaleBench, progress: &dyn Progress) -> anyhow::Result<Option<Figures>> {
    match measure(bench, progress) {
        Err(error) if error.is::<Interrupted>() => Ok(None),
        result => result.map(Some),
    }
}

fn measure(bench: &ScaleBench, progress: &dyn Progress) -> anyhow::Result<Figures> {
    let watch = Watch::start()?;
    let simulated = simulate(bench, &watch, progress)?;
    let (costs, demand) = measure_costs(bench, &watch, progress)?;
    let costs_for_model = Costs {
        worker_s: costs.worker_s,
        ingest_s: costs.ingest_s,
        update_s: costs.update_s,
        update_cpu_s: costs.update_cpu_s,
    };
    let topology = Topology::Hosts {
        cores_per_host: bench.cores_per_host,
        link_bytes_per_s: bench.link_bytes_per_s,
    };
    let model = Model { costs: costs_for_model, demand, topology };
    let this_machine =
        Model { topology: Topology::OneMachine { cores: bench.cores as f64 }, ..model };
    let mut checks = Vec::new();
    for workers in 1..=bench.check_workers {
        progress.stage(&format!("real system with {workers} workers"));
        let window = real_system(bench, workers, &watch)?;
        checks.push(Check::new(&this_machine, workers, &window));
    }
    let machine = Manifest::new(None)?.machine;
    Ok(Figures::new(bench, simulated, costs, model, checks, machine))
}

/// Measures the ingest of one learner with many workers.
fn simulate(
    bench: &ScaleBench,
    watch: &Watch,
    progress: &dyn Progress,
) -> anyhow::Result<Simulated> {
    let size = Size::of_bytes(bench.segment_bytes).context("unsupported segment size")?;
    let spec = spec_of(size);
    // The default configuration, because the task's may need longer observations.
    let mut config = ExperimentConfig::default().resolve(Limits { cores: bench.cores })?;
    config.replay.capacity_steps = bench.config.replay.capacity_steps;
    let feed = feed_plan(bench, &config, &spec);
    progress.stage(&format!("{} synthetic workers", feed.workers));
    let FeedResult { window, feeders_cpu_s, discrepancies } =
        run_feed(&feed, "s", watch, bench.duration)?;
    let folder = temporary_folder()?;
    let insert = costs::insert(&feed, folder.path(), bench.cost_duration)?;
    Ok(Simulated { window, feeders_cpu_s, discrepancies, insert_s: insert.memory_s })
}

fn measure_costs(
    bench: &ScaleBench,
    watch: &Watch,
    progress: &dyn Progress,
) -> anyhow::Result<(CostFigures, Demand)> {
    let ScaleBench { config, cost_duration, .. } = bench;
    progress.stage("cost of a worker");
    let (program, venv) = (bench.program.clone(), bench.venv.clone());
    let worker = costs::worker(program, venv, config, watch, *cost_duration)?;
    progress.stage("cost of ingest");
    let feed = feed_plan(bench, config, &worker.spec);
    let window = run_feed(&feed, "c", watch, *cost_duration)?.window;
    let ingest_s = window.cpu_s / window.total().max(1) as f64;
    let folder = temporary_folder()?;
    let insert = costs::insert(&feed, folder.path(), *cost_duration)?;
    watch.check()?;
    progress.stage("cost of an update");
    let update = costs::update(config, &worker.spec, watch, *cost_duration)?;
    let segment_bytes = feed.segment_bytes()?;
    let demand = Demand {
        steps_per_segment: worker.steps_per_segment,
        updates_per_segment: config.pacing.updates_per_segment,
        segment_bytes,
    };
    let costs = CostFigures {
        worker_s: worker.cpu_s,
        ingest_s,
        insert_s: insert.memory_s,
        log_s: insert.log_s,
        update_s: update.wall_s,
        update_cpu_s: update.cpu_s,
    };
    Ok((costs, demand))
}

fn feed_plan<'a>(
    bench: &'a ScaleBench,
    config: &'a ExperimentConfig,
    spec: &'a EnvSpec,
) -> FeedPlan<'a> {
    FeedPlan {
        program: &bench.program,
        config,
        spec,
        workers: bench.synthetic_workers,
        processes: bench.feeders,
    }
}

/// Result of a complete feed.
struct FeedResult {
    window: FeedWindow,
    /// Processor time of the feeders [s], if the system reports it.
    feeders_cpu_s: Option<f64>,
    discrepancies: Discrepancies,
}

/// Runs a feed from start to end.
fn run_feed(
    plan: &FeedPlan<'_>,
    name: &str,
    watch: &Watch,
    duration: Duration,
) -> anyhow::Result<FeedResult> {
    let folder = temporary_folder()?;
    let run_id = Manifest::new(None)?.run_id;
    let token = format!("{name}{}-{}", &run_id[..8], std::process::id());
    let mut feed = Feed::start(plan, &token, folder.path(), watch)?;
    let before = feed.feeders_cpu_s();
    let window = feed.measure(watch, duration)?;
    let after = feed.feeders_cpu_s();
    let feeders_cpu_s = before.zip(after).map(|(before, after)| after - before);
    Ok(FeedResult { window, feeders_cpu_s, discrepancies: feed.finish(watch)? })
}

fn real_system(bench: &ScaleBench, workers: usize, watch: &Watch) -> anyhow::Result<SteadyWindow> {
    let mut config = bench.config.clone();
    config.actors.workers = workers;
    let system = SystemBench {
        program: bench.program.clone(),
        config,
        evaluate: false,
        duration: bench.check_duration,
    };
    system::measure(&system, watch, &|_| {})
}

fn temporary_folder() -> anyhow::Result<tempfile::TempDir> {
    let folder = tempfile::Builder::new().prefix("dmprl-bench-").tempdir();
    folder.context("cannot make a folder for logs")
}

/// Returns the spec of an environment whose segments have this size.
fn spec_of(size: Size) -> EnvSpec {
    let bounds = vec![(-1.0, 1.0); size.layout.action_len];
    EnvSpec::new("Synthetic-v0", size.layout.observation_len, &bounds, 0.02, 50)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic_segments::SIZES;

    #[test]
    fn spec_of_a_size_gives_segments_of_that_size() {
        let config = ExperimentConfig::default().resolve(Limits { cores: 2 }).unwrap();
        for size in SIZES {
            let spec = spec_of(size);
            let plan = FeedPlan {
                program: std::path::Path::new("none"),
                config: &config,
                spec: &spec,
                workers: 2,
                processes: 1,
            };
            assert_eq!(plan.segment_bytes().unwrap(), size.bytes);
        }
    }
}
