//! `dmprl bench scale`: builds the benchmark from the command line.

use std::time::Duration;

use clap::Args;
use clap::builder::PossibleValuesParser;
use dmprl_bench::{self as bench, ScaleBench};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_shared::config::{AlgorithmName, Limits};
use toml::Value;

use super::bench_values::seconds;
use super::configuration::{merge, refuse};
use super::configured::{ConfiguredArgs, flag, make_absolute};
use super::{cores, emit, prepare_python, this_program};
use crate::terminal::TerminalProgress;

const HELP: &str = "\
Four parts:
  simulation  --synthetic-workers synthetic workers, which use the sending code of a run's workers,
              in a few processes at full rate. This process has a real learner, which reads each
              worker's queue in shared memory, checks and settles segments, inserts them into its
              replay and acknowledges them. It is measured for --seconds once the replay is full.
              Shares are each worker's segments divided by an equal share; jain_index is 1 when all
              are equal. Memory is the learner's (VmRSS), including the queues
  costs       processor time per segment of real workers (--workers of them); of the learner's
              thread to take one from as many queues as in the simulation (transport) and to check,
              settle and insert it (ingest); what delivery level `log` adds; and the time of an
              update on --learner-cores threads. Each is measured for --cost-seconds
  model       steps/s and the first bottleneck for 16 to 1024 workers, computed from these costs:
              the workers, the learner's thread, which alternates between segments and updates, or
              the network, if --link-gbps is given. Each worker has a core of its own; the
              learner's host has no workers. For several machines it is a prediction
  check       real systems (as in `bench system`) of 1 to --check-workers workers on this machine
              next to the model, in which learner and workers share its cores. Other load on the
              machine lowers the measured rates; it affects the processor time per step least
Ctrl-C stops the benchmark and leaves nothing behind.

EXAMPLES
  dmprl bench scale
  dmprl bench scale --task pusher --link-gbps 10 --cores-per-host 64 --json
  dmprl bench scale --set pacing.updates_per_segment=0.05 --check-workers 2
  dmprl bench scale --synthetic-workers 512 --seconds 30 --check-workers 0";

/// Arguments of `dmprl bench scale`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct ScaleArgs {
    /// A task of `dmprl tasks`, a Gymnasium id, or your own class.
    #[arg(long, default_value = "reacher")]
    task: String,
    #[command(flatten)]
    configured: ConfiguredArgs,
    /// Number of synthetic workers.
    #[arg(long, value_name = "N", default_value_t = 256,
          value_parser = clap::value_parser!(u16).range(1..=1024))]
    synthetic_workers: u16,
    /// Processes that run the synthetic workers [default: cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    feeders: Option<u16>,
    /// Size of the synthetic segments in bytes.
    #[arg(long, value_name = "N", default_value = "1024",
          value_parser = PossibleValuesParser::new(["1024", "10240"]))]
    segment_bytes: String,
    /// Duration of the simulation [s].
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = seconds)]
    seconds: f64,
    /// Duration of the measurement of each cost [s].
    #[arg(long, value_name = "S", default_value_t = 2.0, value_parser = seconds)]
    cost_seconds: f64,
    /// Also measure real systems of 1 to N workers and compare them with the model; 0: none.
    #[arg(long, value_name = "N", default_value_t = 4,
          value_parser = clap::value_parser!(u16).range(0..=64))]
    check_workers: u16,
    /// Duration of the measurement of each real system [s].
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = seconds)]
    check_seconds: f64,
    /// Threads of an update, on this machine's cores [default: as configured].
    #[arg(long, value_name = "N")]
    learner_cores: Option<u32>,
    /// Workers per host in the model [default: this machine's cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    cores_per_host: Option<u16>,
    /// Bandwidth of the network into the learner's host [Gbit/s; default: unlimited].
    #[arg(long, value_name = "G", value_parser = gigabits)]
    link_gbps: Option<f64>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

fn gigabits(text: &str) -> Result<f64, String> {
    let rate = text.parse::<f64>().ok().filter(|rate| rate.is_finite() && *rate > 0.0);
    rate.ok_or_else(|| "expected a positive number".to_owned())
}

pub(super) fn run(args: &ScaleArgs) -> anyhow::Result<Outcome> {
    let cores = cores();
    let threads = args.learner_cores.map(|threads| Value::Integer(threads.into()));
    let threads = flag("--learner-cores", "learner.threads", threads);
    let config = merge(&args.configured.sources(&args.task, [threads])?)?;
    let mut config = config.resolve(Limits { cores }).map_err(refuse)?;
    if config.algorithm.name == AlgorithmName::Ndp {
        return Err(wrong_use(
            "--algo ndp: it learns from whole rollouts, not from batches of a replay; expected \
             ddpg, td3, sac or tqc",
        ));
    }
    if config.run.deterministic {
        return Err(wrong_use("run.deterministic: such a run is one process with one worker"));
    }
    if config.learner.threads > cores {
        return Err(wrong_use(format!(
            "--learner-cores {}: an update is measured, not extrapolated; this machine has {cores}",
            config.learner.threads
        )));
    }
    make_absolute(&mut config)?;
    let segment_bytes = args.segment_bytes.parse().map_err(|_| wrong_use("--segment-bytes"))?;
    let whole = |count: Option<u16>| count.map_or(cores, usize::from);
    let bench = ScaleBench {
        program: this_program()?,
        config,
        venv: prepare_python()?,
        synthetic_workers: usize::from(args.synthetic_workers),
        feeders: whole(args.feeders).min(usize::from(args.synthetic_workers)),
        segment_bytes,
        duration: Duration::from_secs_f64(args.seconds),
        cost_duration: Duration::from_secs_f64(args.cost_seconds),
        check_workers: usize::from(args.check_workers),
        check_duration: Duration::from_secs_f64(args.check_seconds),
        cores,
        cores_per_host: whole(args.cores_per_host),
        link_bytes_per_s: args.link_gbps.map(|gigabits| gigabits * 1e9 / 8.0),
    };
    let Some(figures) = bench::scale(&bench, &TerminalProgress::default())? else {
        return Ok(Outcome::Interrupted);
    };
    emit(&if args.json { figures.json().to_string() } else { figures.text() })?;
    Ok(Outcome::Done)
}
