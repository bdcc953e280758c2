//! `dmprl bench system`: measures a real `dmprl train` while it learns.
//!
//! The run is a normal one, with supervisor, learner and workers, in a temporary folder. Its rates
//! are differences between two lines of its `metrics.jsonl` (`steady`). Processor times come from
//! `/proc` at the times when these lines appear. The measurement excludes start-up, the warm-up
//! without updates, and the first second after it.

mod figures;
mod steady;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, bail};
use dmprl_run::Manifest;
use dmprl_run::Progress;
use dmprl_run::{Interrupted, Watch};
use dmprl_shared::config::ExperimentConfig;
use dmprl_supervisor::WholeRun;

pub use figures::Figures;
#[cfg(test)]
pub(super) use steady::CpuTime;
use steady::MetricsMonitor;
pub(super) use steady::SteadyWindow;

/// More steps than any measurement reaches.
const STEPS: u64 = 1_000_000_000_000;
/// Maximum number of environment steps between two lines of metrics. The measurement starts and
/// ends at a line.
const METRICS_STEPS_MAX: u64 = 500;

/// Settings of the benchmark.
pub struct SystemBench {
    /// Path of this program, which also runs the other processes.
    pub program: PathBuf,
    /// The resolved configuration.
    pub config: ExperimentConfig,
    /// Whether to evaluate the policy as configured, or never.
    pub evaluate: bool,
    /// Minimum duration of the measurement.
    pub duration: Duration,
}

/// Runs the benchmark; returns `None` if the user interrupted it. Removes all its processes and
/// files.
///
/// # Errors
/// The run cannot be started, ends early, or makes no progress.
pub fn system(bench: &SystemBench, progress: &dyn Progress) -> anyhow::Result<Option<Figures>> {
    let watch = Watch::start()?;
    progress.stage("starting the run");
    let report = |what: &str| progress.stage(what);
    match measure(bench, &watch, &report) {
        Err(error) if error.is::<Interrupted>() => Ok(None),
        result => {
            let machine = Manifest::new(None)?.machine;
            Ok(Some(Figures::new(bench, result?, machine)))
        }
    }
}

/// Starts a run and measures its steady state. `report` receives progress messages.
pub(super) fn measure(
    bench: &SystemBench,
    watch: &Watch,
    report: &dyn Fn(&str),
) -> anyhow::Result<SteadyWindow> {
    let folder = tempfile::Builder::new().prefix("dmprl-bench-").tempdir();
    let folder = folder.context("cannot make a folder for the run")?;
    let log = folder.path().join("train.log");
    let mut train = WholeRun::start(command(bench, folder.path())?, &log)?;
    let metrics = folder.path().join("run/metrics.jsonl");
    let measured = MetricsMonitor::new(&metrics, train.pid()?, bench)
        .until_measured(&mut train, watch, report);
    // Always stop the run as a user would, so that it removes its processes and shared memory.
    let failure = if train.end()?.is_none() { train.stop()? } else { None };
    let window = measured?;
    match failure {
        Some(how) => bail!("dmprl train did not end cleanly: {how}"),
        None => Ok(window),
    }
}

/// Returns the command of `dmprl train` with the complete configuration as a file.
fn command(bench: &SystemBench, folder: &Path) -> anyhow::Result<Command> {
    let mut config = bench.config.clone();
    config.run.steps = STEPS;
    config.metrics.interval_steps = config.metrics.interval_steps.min(METRICS_STEPS_MAX);
    // No workers join during a benchmark.
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
