//! `dmprl bench peers`: the time until a policy reaches a target, or how good it is after a given
//! time, beside other libraries.
//!
//! Every round trains each candidate once with the round's seed, in turns, so that a drift of the
//! machine's speed affects all alike. `ours` is a whole `dmprl train`, measured from the start of
//! its process to its end. A peer is a process of `tests/peers/agent_peer.py` (`peer`), measured
//! from its start to the end of the evaluation that reaches the target. Evaluations, environments
//! and the number of steps before the first update are the same for all. Without a target, the only
//! evaluation is that of the last policy, and the time limit does not include it.

mod figures;
mod ours;
mod peer;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use dmprl_run::{Interrupted, Manifest, Progress, Watch};
use dmprl_shared::config::ExperimentConfig;
use serde::{Deserialize, Serialize};

use super::announce_round;

pub use figures::Figures;
pub use peer::AgentKind;

/// Settings of the benchmark.
pub struct AgentsBench {
    /// Path of this program.
    pub program: PathBuf,
    /// The resolved configuration of ours. `run.until_return` or `run.until_success` is the target,
    /// if either is finite; `run.steps` and `run.max_minutes` are the limits of each training.
    pub config: ExperimentConfig,
    /// The peers.
    pub peers: Vec<AgentKind>,
    /// Whether the peers have our settings instead of their libraries' defaults.
    pub equal_settings: bool,
    /// Number of seeds, beginning with the configured one.
    pub seeds: u64,
    /// Python interpreter of the peers.
    pub peer_python: PathBuf,
    /// Folder with the peers' script.
    pub peers_path: PathBuf,
    /// Folder with the package `dmprl`.
    pub package_path: PathBuf,
}

/// What ends a training, besides its limits.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Target {
    /// An evaluation with this mean return.
    Return(f64),
    /// An evaluation with this success rate.
    Success(f64),
    /// Nothing: all trainings last as long, and their last policies are compared.
    None,
}

impl Target {
    fn of(config: &ExperimentConfig) -> Self {
        let (by_return, by_success) = (config.run.until_return, config.run.until_success);
        match (by_return.is_finite(), by_success.is_finite()) {
            (true, _) => Self::Return(by_return),
            (_, true) => Self::Success(by_success),
            _ => Self::None,
        }
    }

    /// Whether an evaluation reaches the target.
    fn is_reached(self, evaluated: &Evaluated) -> bool {
        match self {
            Self::Return(target) => evaluated.return_mean >= target,
            Self::Success(target) => evaluated.success_rate.is_some_and(|rate| rate >= target),
            Self::None => false,
        }
    }
}

/// Result of an evaluation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Evaluated {
    return_mean: f64,
    /// `None` if the environment reports no success.
    success_rate: Option<f64>,
}

/// One training, until the target or a limit.
#[derive(Debug, Clone, PartialEq)]
struct Training {
    reached: bool,
    /// Time from the start of the process to the end.
    seconds: f64,
    /// The part until the first environment step; `None` without one.
    start_s: Option<f64>,
    /// The part that only evaluates; 0 if evaluations run beside the training.
    evaluation_s: f64,
    env_steps: u64,
    /// The last evaluation; `None` without one.
    evaluated: Option<Evaluated>,
}

/// Runs the benchmark. If the user interrupts it, returns the trainings that have ended, or `None`
/// if none has. Removes all its processes and files.
///
/// # Errors
/// One of our trainings fails.
pub fn agents(bench: &AgentsBench, progress: &dyn Progress) -> anyhow::Result<Option<Figures>> {
    let watch = Watch::start()?;
    let mut figures = Figures::new(bench, Manifest::new(None)?.machine);
    match measure(bench, &watch, progress, &mut figures) {
        Err(error) if error.is::<Interrupted>() => {
            figures.interrupted = true;
            Ok(figures.has_trainings().then_some(figures))
        }
        result => result.map(|()| Some(figures)),
    }
}

fn measure(
    bench: &AgentsBench,
    watch: &Watch,
    progress: &dyn Progress,
    figures: &mut Figures,
) -> anyhow::Result<()> {
    let folder = tempfile::Builder::new().prefix("dmprl-bench-").tempdir();
    let folder = folder.context("cannot make a folder for the trainings")?;
    for round in 0..bench.seeds {
        announce_round(progress, round as usize, bench.seeds as usize);
        let mut config = bench.config.clone();
        config.run.seed += round;
        progress.detail("ours");
        let place = folder.path().join(format!("ours-{round}"));
        let training = ours::train(&bench.program, &config, &place, watch)?;
        figures.add(None, training, progress);
        for kind in &bench.peers {
            progress.detail(kind.name());
            let place = folder.path().join(format!("{}-{round}", kind.name()));
            match peer::train(*kind, bench, &config, &place, watch)? {
                Ok((about, training)) => {
                    figures.note(*kind, about);
                    figures.add(Some(*kind), training, progress);
                }
                Err(why) => {
                    progress.print(&format!("{}: {why}", kind.name()));
                    figures.note(*kind, why);
                }
            }
        }
    }
    Ok(())
}

/// Maximum time of a training, until it counts as hanging.
fn limit(config: &ExperimentConfig) -> Duration {
    /// For start and end, and for the evaluation that is running at the limit.
    const SLACK_S: f64 = 900.0;
    Duration::from_secs_f64(config.run.max_minutes * 60.0 + SLACK_S)
}
