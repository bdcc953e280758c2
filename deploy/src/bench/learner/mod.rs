//! `dmprl bench learner`: an update beside its floor and beside PyTorch's and JAX's, in turn.
//!
//! Ours is the learner of a run on a replay full of made-up segments (`synthetic`), so it needs
//! neither Python nor an environment. The floor is the update's matrix products and nothing else
//! (`work`); the peers do the same update in processes of their own (`peers`). In every round each
//! runs once for the same time while the others sleep, because a machine's speed drifts; medians
//! over the rounds, and of the rounds' own ratios, count (`figures`, `table`).

mod figures;
mod peers;
mod synthetic;
mod table;
mod work;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use dmprl_learner::learner::Learner;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::spec::EnvSpec;

use super::child::resident_bytes_max;
use super::watch::{Interrupted, Watch};
use crate::terminal::RoundsProgress;

pub use figures::Figures;
pub(super) use figures::Timed;
pub use peers::PeerKind;
pub(super) use synthetic::fill;
pub use synthetic::spec_of;
pub(super) use work::timed;

use figures::{KERNELS, LIBRARY, OPTIMISER, OURS, SAMPLE};
use peers::Peer;
use work::{FloorWork, OptimiserWork, SampleWork};

/// What to measure.
pub struct LearnerBench {
    /// The resolved configuration.
    pub config: ExperimentConfig,
    /// The task's sizes.
    pub spec: EnvSpec,
    /// Who else does the update.
    pub peers: Vec<PeerKind>,
    /// The interpreter that they run in.
    pub peer_python: PathBuf,
    /// The folder of their script.
    pub peers_path: PathBuf,
    /// How often each is measured.
    pub rounds: usize,
    /// How long each time.
    pub duration: Duration,
}

/// Measures; none when the user interrupted it. Leaves no process and no file behind.
///
/// # Errors
/// The learner cannot be built or diverges, or a peer has died in the middle.
pub fn learner(bench: LearnerBench) -> anyhow::Result<Option<Figures>> {
    match measure(&bench) {
        Err(error) if error.is::<Interrupted>() => Ok(None),
        result => result.map(Some),
    }
}

fn measure(bench: &LearnerBench) -> anyhow::Result<Figures> {
    let watch = Watch::start()?;
    let folder = tempfile::Builder::new().prefix("dmprl-bench-").tempdir();
    let folder = folder.context("cannot make a folder for the peers' logs")?;
    let progress = RoundsProgress::new(bench.rounds);
    progress.preparing("filling the replay");
    let mut figures = Figures::new(bench);
    // Before the replay is filled: reading their packages takes as long.
    let mut peers = Vec::new();
    for kind in &bench.peers {
        match Peer::start(*kind, bench, folder.path()) {
            Ok(peer) => peers.push(peer),
            // Such as a --peer-python that is no program.
            Err(error) => figures.note(kind.name(), &format!("{error:#}")),
        }
    }
    let mut learner = Learner::new(bench.config.clone(), &bench.spec, synthetic::RUN_ID)?;
    synthetic::fill(&mut learner, &bench.spec)?;
    watch.check()?;
    timed(bench.duration, || Ok(learner.update()?))?;
    // Before the benchmark makes buffers of its own.
    figures.peak_memory_bytes = resident_bytes_max("self");
    let mut work = Work::new(&learner);
    progress.preparing("starting what it is compared with");
    let mut ready = Vec::new();
    for mut peer in peers {
        let greeting = peer.ready(&watch)?;
        figures.note(peer.kind.name(), greeting.as_ref().unwrap_or_else(|why| why));
        if greeting.is_ok() {
            ready.push(peer);
        }
    }
    for round in 0..bench.rounds {
        progress.round(round);
        for peer in &mut ready {
            progress.measuring(peer.kind.name());
            figures.add(peer.kind.name(), peer.measure(&watch, bench.duration)?);
        }
        progress.measuring(OURS);
        work.round(&mut learner, &watch, bench.duration, &mut figures)?;
    }
    Ok(figures)
}

/// What this process does itself in a round.
struct Work {
    floor: FloorWork,
    sample: SampleWork,
    optimiser: OptimiserWork,
}

impl Work {
    fn new(learner: &Learner) -> Self {
        Self {
            floor: FloorWork::new(learner),
            sample: SampleWork::new(learner),
            optimiser: OptimiserWork::new(learner),
        }
    }

    fn round(
        &mut self,
        learner: &mut Learner,
        watch: &Watch,
        duration: Duration,
        figures: &mut Figures,
    ) -> anyhow::Result<()> {
        use dmprl_learner::update::floor::Engine;
        let Self { floor, sample, optimiser } = self;
        // Ours in the middle, so that a machine that drifts does so for both sides.
        figures.add(LIBRARY, floor.measure(Engine::Library, duration)?);
        watch.check()?;
        figures.add(OURS, timed(duration, || Ok(learner.update()?))?);
        watch.check()?;
        figures.add(KERNELS, floor.measure(Engine::Kernels, duration)?);
        // Small parts of an update: a shorter time will do.
        figures.add(SAMPLE, sample.measure(learner, duration / 4)?);
        figures.add(OPTIMISER, optimiser.measure(duration / 4)?);
        watch.check()
    }
}
