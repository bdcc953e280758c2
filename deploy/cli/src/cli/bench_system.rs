//! `dmprl bench system`: builds the benchmark from the command line.

use std::time::Duration;

use clap::Args;
use dmprl_bench::{self as bench, SystemBench};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_shared::config::{ExperimentConfig, Limits};

use super::bench_values::seconds;
use super::configuration::{merge, refuse};
use super::configured::{ConfiguredArgs, make_absolute};
use super::{cores, emit, prepare_python, this_program};
use crate::terminal::TerminalProgress;

const HELP: &str = "\
Starts a real `dmprl train` in a temporary folder and measures it for --seconds: its supervisor, its
learner, its workers. The policy is evaluated only with --evaluate; checkpoints are written as
configured. Rates are differences between two lines of the run's metrics.jsonl, which has a line at
least every 500 steps. The measurement excludes the start, the warm-up (exploration.warm_up_steps),
during which nothing is learned, and one second after it.
  updates_per_segment   as measured, next to the configured pacing (pacing.updates_per_segment)
  policy_lag            newest policy version minus the version that acted: the median of the
                        lines' medians, and the maximum
  busy, *_utilisation   processor time of the learner and of the workers, as a fraction of one core
                        per thread; the one near 100 % limits the rates, if the machine has enough
                        cores for both
Ctrl-C stops the benchmark at once and leaves nothing behind.

EXAMPLES
  dmprl bench system --task reacher
  dmprl bench system --task pusher --workers 2 --envs-per-worker 16 --seconds 30 --json
  dmprl bench system --task reacher --preset fast --evaluate
  dmprl bench system --task reacher --set pacing.updates_per_segment=0.1";

/// Arguments of `dmprl bench system`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct SystemArgs {
    /// A task of `dmprl tasks`, a Gymnasium id, or your own class.
    #[arg(long)]
    task: String,
    #[command(flatten)]
    configured: ConfiguredArgs,
    /// Minimum duration of the measurement, without start and warm-up [s].
    #[arg(long, value_name = "S", default_value_t = 20.0, value_parser = seconds)]
    seconds: f64,
    /// Evaluate the policy as configured.
    #[arg(long)]
    evaluate: bool,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &SystemArgs) -> anyhow::Result<Outcome> {
    let config = whole_system(&args.configured, &args.task)?;
    // Prepare Python before the clock starts: it can take minutes.
    prepare_python()?;
    let bench = SystemBench {
        program: this_program()?,
        config,
        evaluate: args.evaluate,
        duration: Duration::from_secs_f64(args.seconds),
    };
    let Some(figures) = bench::system(&bench, &TerminalProgress::default())? else {
        return Ok(Outcome::Interrupted);
    };
    emit(&if args.json { figures.json().to_string() } else { figures.text() })?;
    Ok(Outcome::Done)
}

/// Merges the configuration of a run with several processes.
pub(super) fn whole_system(
    configured: &ConfiguredArgs,
    task: &str,
) -> anyhow::Result<ExperimentConfig> {
    let config = merge(&configured.sources(task, [])?)?;
    let mut config = config.resolve(Limits { cores: cores() }).map_err(refuse)?;
    if config.run.deterministic {
        return Err(wrong_use(
            "run.deterministic: such a run is one process, so there is no system to measure",
        ));
    }
    make_absolute(&mut config)?;
    Ok(config)
}
