//! `dmprl chaos`: builds the trial from the command line.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::bail;
use clap::Args;
use dmprl_chaos::{TrialPlan, chaos};
use dmprl_run::failure::Outcome;

use super::{emit, prepare_python, this_program};
use crate::terminal::TerminalProgress;

const HELP: &str = "\
Starts a real `dmprl train` at delivery level `log`. By a schedule derived from the seed it kills
workers (one, all at once, during their start), the learner (also while it recovers or writes a
checkpoint) and the evaluator with SIGKILL, and suspends workers and the learner for a while.
Workers and learner log every segment, and a checker finally verifies:
  I1 no acknowledged segment is lost        I2 no segment is inserted twice
  I3 sequence numbers only increase         I4 payloads arrive as produced
  I5 counters go back to a checkpoint only  I6 policy versions never decrease
  I7 work continues, all workers come back  I8 nothing is left behind
  I9 produced = inserted + rejected + in flight with killed workers
Reported but not checked, as they depend on the machine: worker_back_s, learner_back_s (from SIGKILL
to the first segment inserted), fairness (most over fewest segments of a worker while no fault was
active) and the *_ratio (last third of the trial over the first, the larger of supervisor and
learner). Ctrl-C ends the trial: the run recovers, is stopped and checked. Exit status 1 if a check
failed; the run is then kept.

EXAMPLES
  dmprl chaos --seed 1 --seconds 60
  dmprl chaos --seed 7 --seconds 1800 --worker-kills 1000 --learner-kills 100 --json
  dmprl chaos --task pusher --workers 4 --output chaos-pusher";

/// Arguments of `dmprl chaos`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct ChaosArgs {
    /// Seed of the schedule of faults and their targets.
    #[arg(long, value_name = "S", default_value_t = 1,
          value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    seed: u64,
    /// Minimum duration of the fault injection, without start and recovery [s].
    #[arg(long, value_name = "N", default_value_t = 60,
          value_parser = clap::value_parser!(u64).range(1..=86_400))]
    seconds: u64,
    /// A task of `dmprl tasks`, or any other that `train` accepts.
    #[arg(long, default_value = "reacher")]
    task: String,
    /// Number of worker processes.
    #[arg(long, value_name = "W", default_value_t = 2,
          value_parser = clap::value_parser!(u32).range(1..=64))]
    workers: u32,
    /// Continue beyond --seconds until this many workers have been killed.
    #[arg(long, value_name = "N", default_value_t = 0)]
    worker_kills: u64,
    /// Continue beyond --seconds until this many learners have been killed.
    #[arg(long, value_name = "N", default_value_t = 0)]
    learner_kills: u64,
    /// Directory to keep the run and its logs in, new or empty [default: a temporary folder,
    /// removed if all checks pass].
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &ChaosArgs) -> anyhow::Result<Outcome> {
    // Prepare Python before the clock starts: it can take minutes.
    prepare_python()?;
    let plan = TrialPlan {
        program: this_program()?,
        task: args.task.clone(),
        workers: args.workers,
        seed: args.seed,
        duration: Duration::from_secs(args.seconds),
        worker_kills: args.worker_kills,
        learner_kills: args.learner_kills,
        output: args.output.clone(),
    };
    let report = chaos(&plan, &TerminalProgress::default())?;
    emit(&if args.json { report.json().to_string() } else { report.text() })?;
    if !report.is_sound() {
        bail!("the run violated its guarantees; the report describes each violation");
    }
    Ok(if report.is_interrupted() { Outcome::Interrupted } else { Outcome::Done })
}
