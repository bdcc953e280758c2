//! `dmprl bench rollout`: compares the workers with their peers.
//!
//! A machine's speed drifts. Each round therefore runs every candidate once, for the same time,
//! while the others sleep, and the report has the median over the rounds. A worker sleeps because
//! its queue is full, a peer because it waits for a request.

use std::path::PathBuf;
use std::time::Duration;

use dmprl_run::Progress;
use dmprl_run::RunDirectory;
use dmprl_run::{Interrupted, Watch};
use dmprl_shared::config::ExperimentConfig;

use super::figures::{Figures, ONE_WORKER, WORKER, WorkerFigures};
use super::numpy_plan::{Controls, NumpyPlan};
use super::peers::{PANDA_GYM, Peer, PeerKind, PeerSetup, is_in_panda_gym};
use super::workers::{BenchRun, Workers};
use crate::announce_round;

/// Settings of the benchmark.
pub struct RolloutBench {
    /// Path of this program, which also runs the workers.
    pub program: PathBuf,
    /// The resolved configuration.
    pub config: ExperimentConfig,
    /// Python virtual environment of the workers.
    pub venv: PathBuf,
    /// Folder with the Python package.
    pub package_path: PathBuf,
    /// Python interpreter for EnvPool and panda-gym.
    pub peer_python: PathBuf,
    /// Controls for the benchmark of physics alone.
    pub controls: Controls,
    /// Number of rounds.
    pub rounds: usize,
    /// Duration of each measurement.
    pub duration: Duration,
}

/// Runs the benchmark; returns `None` if the user interrupted it. Removes all its processes and
/// files.
///
/// # Errors
/// A worker or a peer cannot be started or dies.
pub fn rollout(bench: RolloutBench, progress: &dyn Progress) -> anyhow::Result<Option<Figures>> {
    match measure(bench, progress) {
        Err(error) if error.is::<Interrupted>() => Ok(None),
        result => result.map(Some),
    }
}

fn measure(bench: RolloutBench, progress: &dyn Progress) -> anyhow::Result<Figures> {
    let watch = Watch::start()?;
    // Dropped in reverse order: processes, shared memory, files.
    let bench_run = BenchRun::new(bench.program.clone(), bench.venv.clone(), &bench.config)?;
    let run = &bench_run.launcher.run;
    progress.stage("starting the workers");
    // Start the workers alone, so that nothing else delays their first segments.
    let mut workers = Workers::start(&bench_run, &watch)?;
    progress.stage("starting the peers");
    let mut figures = Figures::new(&bench, &workers.spec, bench_run.manifest.machine.clone());
    let mut peers = start_peers(&bench, run, &workers, &watch, &mut figures)?;
    let mut sink_cpu_s = 0.0;
    let mut measured_s = 0.0;
    for round in 0..bench.rounds {
        announce_round(progress, round, bench.rounds);
        for peer in &mut peers {
            progress.detail(peer.kind.name());
            figures.add(peer.kind.name(), peer.measure(&watch, bench.duration)?);
        }
        progress.detail(WORKER);
        // Comes first, while the other workers' queues are still full.
        if let Some(one) = workers.measure_first(&watch, bench.duration)? {
            figures.add(ONE_WORKER, one);
        }
        let (round, window) = workers.measure(&watch, bench.duration)?;
        figures.add(WORKER, round);
        sink_cpu_s += window.cpu_s;
        measured_s += window.seconds;
    }
    let discrepancies = workers.discrepancies();
    figures.workers = WorkerFigures {
        first_segment_s: workers.first_segment_s,
        rss_bytes: workers.resident_bytes_max(),
        sink_cpu_share: sink_cpu_s / measured_s,
        rejected: discrepancies.rejected,
        lost: discrepancies.lost,
    };
    Ok(figures)
}

/// Starts all peers. Adds a note to `figures` for each unavailable one.
fn start_peers(
    bench: &RolloutBench,
    run: &RunDirectory,
    workers: &Workers,
    watch: &Watch,
    figures: &mut Figures,
) -> anyhow::Result<Vec<Peer>> {
    let Workers { spec, policy, parameters, .. } = workers;
    let plan =
        NumpyPlan::write(run.path(), &bench.config, spec, bench.controls, policy, parameters)?;
    let package_path = bench.package_path.clone();
    let setup = PeerSetup { run, package_path, plan, workers: bench.config.actors.workers };
    let own_python = bench.venv.join("bin/python");
    // Started together, because importing Python packages takes most of the time.
    let applies = |kind: &PeerKind| *kind != PeerKind::PandaGym || is_in_panda_gym(&spec.id);
    if !is_in_panda_gym(&spec.id) {
        figures.note(PANDA_GYM, &format!("panda-gym has no {}", spec.id));
    }
    let started = PeerKind::ALL.into_iter().filter(applies).map(|kind| {
        let python = if kind.is_foreign() { &bench.peer_python } else { &own_python };
        (kind, Peer::start(kind, python, &setup))
    });
    let started: Vec<_> = started.collect();
    let mut peers = Vec::new();
    for (kind, peer) in started {
        let mut peer = match peer {
            Ok(peer) => peer,
            // For example, `--peer-python` is not an executable.
            Err(error) => {
                figures.note(kind.name(), &format!("{error:#}"));
                continue;
            }
        };
        let ready = peer.ready(watch)?;
        figures.note(peer.kind.name(), ready.as_ref().unwrap_or_else(|why| why));
        if ready.is_ok() {
            peers.push(peer);
        }
    }
    Ok(peers)
}
