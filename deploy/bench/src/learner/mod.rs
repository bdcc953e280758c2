//! `dmprl bench learner`: compares an update with its matrix products, PyTorch and JAX.
//!
//! `ours` is the learner of a run on a replay full of synthetic segments (`synthetic`), so it needs
//! neither Python nor an environment. The floor consists of the update's matrix products alone
//! (`products`, `floor`). Other parts of the update are measured separately (`parts`, `optimiser`).
//! The peers do the same update in their own processes (`peers`). Because a machine's speed drifts,
//! each round runs every candidate once, for the same time, while the others sleep. The report has
//! the medians over the rounds of the times and of their ratios (`figures`, `table`).

mod figures;
mod floor;
mod optimiser;
mod parts;
mod peers;
mod products;
mod synthetic;
mod table;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use dmprl_learner::learner::Learner;
use dmprl_run::Progress;
use dmprl_run::{Interrupted, Watch};
use dmprl_shared::config::{ExperimentConfig, Precision};
use dmprl_shared::spec::EnvSpec;

use super::child::resident_bytes_max;
use crate::announce_round;

pub use figures::Figures;
pub(super) use figures::Timed;
pub(super) use parts::timed;
pub use peers::PeerKind;
pub(super) use synthetic::{STEPS, fill};

use figures::{HANDOVER, KERNELS, LIBRARY, LIMIT, OPTIMISER, OURS, SAMPLE};
use floor::Engine;
use parts::{FloorWork, LimitWork, OptimiserWork, SampleWork, handover};
use peers::Peer;
use products::Cycle;

/// Settings of the benchmark.
pub struct LearnerBench {
    /// The resolved configuration.
    pub config: ExperimentConfig,
    /// Spec of the task's environment.
    pub spec: EnvSpec,
    /// Steps in the replay, unless it is smaller.
    pub replay_steps: usize,
    /// Peers that do the same update.
    pub peers: Vec<PeerKind>,
    /// Python interpreter of the peers.
    pub peer_python: PathBuf,
    /// Folder with the peers' script.
    pub peers_path: PathBuf,
    /// Number of rounds.
    pub rounds: usize,
    /// Duration of each measurement.
    pub duration: Duration,
}

/// Runs the benchmark; returns `None` if the user interrupted it. Removes all its processes and
/// files.
///
/// # Errors
/// The learner cannot be built or diverges, or a peer dies during a measurement.
pub fn learner(bench: LearnerBench, progress: &dyn Progress) -> anyhow::Result<Option<Figures>> {
    match measure(&bench, progress) {
        Err(error) if error.is::<Interrupted>() => Ok(None),
        result => result.map(Some),
    }
}

fn measure(bench: &LearnerBench, progress: &dyn Progress) -> anyhow::Result<Figures> {
    let watch = Watch::start()?;
    let folder = tempfile::Builder::new().prefix("dmprl-bench-").tempdir();
    let folder = folder.context("cannot make a folder for the peers' logs")?;
    progress.stage("filling the replay");
    let mut figures = Figures::new(bench);
    // Started first, so that they import their packages while the replay is filled.
    let mut peers = Vec::new();
    for kind in &bench.peers {
        match Peer::start(*kind, bench, folder.path()) {
            Ok(peer) => peers.push(peer),
            // For example, `--peer-python` is not an executable.
            Err(error) => figures.note(kind.name(), &format!("{error:#}")),
        }
    }
    let mut learner = Learner::new(bench.config.clone(), &bench.spec, synthetic::RUN_ID)?;
    figures.replay_steps = fill(&mut learner, &bench.spec, bench.replay_steps)?;
    watch.check()?;
    timed(bench.duration, || Ok(learner.update()?))?;
    // Measured before the benchmark allocates its own buffers.
    figures.peak_memory_bytes = resident_bytes_max("self");
    let mut work = OwnWork::new(&learner)?;
    progress.stage("starting the peers");
    let mut ready = Vec::new();
    for mut peer in peers {
        let greeting = peer.ready(&watch)?;
        figures.note(peer.kind.name(), greeting.as_ref().unwrap_or_else(|why| why));
        if greeting.is_ok() {
            ready.push(peer);
        }
    }
    for round in 0..bench.rounds {
        announce_round(progress, round, bench.rounds);
        for peer in &mut ready {
            progress.detail(peer.kind.name());
            figures.add(peer.kind.name(), peer.measure(&watch, bench.duration)?);
        }
        progress.detail(OURS);
        work.round(&mut learner, &watch, bench.duration, &mut figures)?;
    }
    Ok(figures)
}

/// The candidates that run in this process.
struct OwnWork {
    floor: FloorWork,
    limit: LimitWork,
    sample: SampleWork,
    optimiser: OptimiserWork,
}

impl OwnWork {
    fn new(learner: &Learner) -> anyhow::Result<Self> {
        let cycle = Cycle::of(learner);
        Ok(Self {
            floor: FloorWork::new(learner, &cycle),
            limit: LimitWork::new(learner, &cycle),
            sample: SampleWork::new(learner)?,
            optimiser: OptimiserWork::new(learner, &cycle),
        })
    }

    fn round(
        &mut self,
        learner: &mut Learner,
        watch: &Watch,
        duration: Duration,
        figures: &mut Figures,
    ) -> anyhow::Result<()> {
        let Self { floor, limit, sample, optimiser } = self;
        // The update runs between the two floors, so that drift of the machine's speed affects
        // both alike.
        figures.add(LIBRARY, floor.measure(Engine::Library, duration)?);
        watch.check()?;
        figures.add(OURS, timed(duration, || Ok(learner.update()?))?);
        watch.check()?;
        figures.add(KERNELS, floor.measure(Engine::Kernels, duration)?);
        // The limit is that of 32-bit numbers.
        if learner.config().learner.precision == Precision::F32 {
            figures.add(LIMIT, limit.measure(duration)?);
        }
        if learner.config().learner.threads > 1 {
            figures.add(HANDOVER, handover());
        }
        // Short calls compared with an update: less time is enough.
        figures.add(SAMPLE, sample.measure(learner, duration / 4)?);
        figures.add(OPTIMISER, optimiser.measure(duration / 4)?);
        watch.check()
    }
}
