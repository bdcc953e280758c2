//! `dmprl chaos`: from the command line to the trial.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::bail;
use clap::Args;

use super::{emit, prepare_python, this_program};
use crate::chaos::{TrialPlan, chaos};
use crate::failure::Outcome;

const HELP: &str = "\
Starts a real `dmprl train` at delivery level `log` and, by a schedule that the seed decides, kills
workers (one, all at once, while they start), the learner (also while it recovers and while it
writes a checkpoint) and the evaluator with SIGKILL, and stops workers and the learner for a while.
Workers and learner note every segment, so that in the end a checker can tell:
  I1 nothing acknowledged is lost           I2 nothing is inserted twice
  I3 sequences only increase                I4 payloads arrive as they were produced
  I5 counters go back to a checkpoint only  I6 policies only become newer
  I7 work goes on, all workers come back    I8 nothing is left behind
  I9 produced = inserted + rejected + in flight with the killed
worker_back_s, learner_back_s (from SIGKILL to the first segment inserted), fairness (most over
fewest segments of a worker while nothing was broken) and the *_ratio (last third of the trial over
the first, the larger of supervisor and learner) are measured and judge nothing: they depend on the
machine. Ctrl-C ends it: the run heals, is stopped and judged. Exit status 1 if anything did not
hold; everything is then kept.

EXAMPLES
  dmprl chaos --seed 1 --seconds 60
  dmprl chaos --seed 7 --seconds 1800 --worker-kills 1000 --learner-kills 100 --json
  dmprl chaos --task pusher --workers 4 --output chaos-pusher";

/// Arguments of `dmprl chaos`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct ChaosArgs {
    /// Decides which fault comes when, and whom it strikes.
    #[arg(long, value_name = "S", default_value_t = 1,
          value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    seed: u64,
    /// How long the run is struck, at least; starting and healing come on top [s].
    #[arg(long, value_name = "N", default_value_t = 60,
          value_parser = clap::value_parser!(u64).range(1..=86_400))]
    seconds: u64,
    /// A task of `dmprl tasks`, or anything that `train` takes.
    #[arg(long, default_value = "reacher")]
    task: String,
    /// Worker processes.
    #[arg(long, value_name = "W", default_value_t = 2,
          value_parser = clap::value_parser!(u32).range(1..=64))]
    workers: u32,
    /// Go on beyond --seconds until so many workers have been killed.
    #[arg(long, value_name = "N", default_value_t = 0)]
    worker_kills: u64,
    /// Go on beyond --seconds until so many learners have been killed.
    #[arg(long, value_name = "N", default_value_t = 0)]
    learner_kills: u64,
    /// Where the run and its logs go, and stay; new or empty [default: a temporary folder that is
    /// removed when all is well].
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &ChaosArgs) -> anyhow::Result<Outcome> {
    // Before the clock runs: making the environment takes minutes.
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
    let report = chaos(&plan)?;
    emit(&if args.json { report.json().to_string() } else { report.text() })?;
    if !report.is_sound() {
        bail!("the run broke what it promises; the report has the sentences");
    }
    Ok(if report.is_interrupted() { Outcome::Interrupted } else { Outcome::Done })
}
