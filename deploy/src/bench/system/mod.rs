//! `dmprl bench system`: a real `dmprl train`, measured while it learns.
//!
//! The run is what a user starts: supervisor, learner, workers, in a folder that is removed
//! afterwards. Its rates are differences between two lines of its own `metrics.jsonl` (`steady`),
//! processor time is what `/proc` says when these lines appear. What comes before the first of the
//! two is left out: starting, the warm-up, in which nothing is learned, and a second after it.

mod figures;
mod steady;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, bail};
use dmprl_shared::config::ExperimentConfig;

use super::watch::{Interrupted, Watch};
use crate::launch::WholeRun;
use crate::run_directory::Manifest;
use crate::terminal::RoundsProgress;

pub use figures::Figures;
#[cfg(test)]
pub(super) use steady::CpuTime;
use steady::Steady;
pub(super) use steady::Window;

/// Long beyond any measurement.
const STEPS: u64 = 1_000_000_000_000;
/// Environment steps between two lines of metrics, at most: the window begins and ends with one.
const METRICS_STEPS_MAX: u64 = 500;

/// What to measure.
pub struct SystemBench {
    /// The program that plays every part: this one.
    pub program: PathBuf,
    /// The resolved configuration.
    pub config: ExperimentConfig,
    /// Whether the policy is evaluated as the configuration says, or never.
    pub evaluate: bool,
    /// How long it is measured, at least.
    pub duration: Duration,
}

/// Measures; none when the user interrupted it. Leaves no process and no file behind.
///
/// # Errors
/// The run could not be started, has ended by itself, or makes no progress.
pub fn system(bench: &SystemBench) -> anyhow::Result<Option<Figures>> {
    let watch = Watch::start()?;
    let progress = RoundsProgress::new(1);
    progress.preparing("starting the run");
    let told = |what: &str| progress.preparing(what);
    match measure(bench, &watch, &told) {
        Err(error) if error.is::<Interrupted>() => Ok(None),
        result => {
            let machine = Manifest::new(None)?.machine;
            Ok(Some(Figures::new(bench, result?, machine)))
        }
    }
}

/// The steady state of a run of its own; `told` hears what goes on.
pub(super) fn measure(
    bench: &SystemBench,
    watch: &Watch,
    told: &dyn Fn(&str),
) -> anyhow::Result<Window> {
    let folder = tempfile::Builder::new().prefix("dmprl-bench-").tempdir();
    let folder = folder.context("cannot make a folder for the run")?;
    let log = folder.path().join("train.log");
    let mut train = WholeRun::start(command(bench, folder.path())?, &log)?;
    let metrics = folder.path().join("run/metrics.jsonl");
    let measured =
        Steady::new(&metrics, train.pid()?, bench).until_measured(&mut train, watch, told);
    // However it went: stopped as a user stops it, a run leaves no process and no shared memory.
    let wrong = if train.end()?.is_none() { train.stop()? } else { None };
    let window = measured?;
    match wrong {
        Some(how) => bail!("dmprl train did not end as it should: {how}"),
        None => Ok(window),
    }
}

/// `dmprl train` with the whole configuration as a file.
fn command(bench: &SystemBench, folder: &Path) -> anyhow::Result<Command> {
    let mut config = bench.config.clone();
    config.run.steps = STEPS;
    config.metrics.interval_steps = config.metrics.interval_steps.min(METRICS_STEPS_MAX);
    // Nobody joins a benchmark.
    config.actors.joined_max = 0;
    if !bench.evaluate {
        config.evaluation.interval_steps = STEPS;
    }
    let file = folder.join("config.toml");
    let text = toml::to_string(&config).context("cannot write the configuration as TOML")?;
    std::fs::write(&file, text).with_context(|| format!("cannot write {}", file.display()))?;
    let mut command = Command::new(&bench.program);
    command.arg("train").arg(&config.task.name).arg("--config").arg(&file);
    command.arg("--run-dir").arg(folder.join("run")).arg("--no-progress");
    Ok(command)
}
