//! `dmprl bench transport`: from the command line to the benchmark.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};
use dmprl_shared::config::DeliveryLevel;

use super::bench::{interpreter, seconds};
use super::{cores, emit, python_home, this_program};
use crate::bench::{self, TransportBench};
use crate::failure::{Outcome, wrong_use};

const HELP: &str = "\
For segments of 1024 and of 10240 bytes. In every round each of these runs once for --seconds, the
others asleep; the median counts.
  shared_memory          worker processes that only send, by the code of a run's workers: checksum,
                         outbox, queue, acknowledgements; this process takes, checks, settles and
                         acknowledges in the learner's place, at --level log after it has appended
                         to a segment log in the folder for temporary files
  pipe, unix_socket      one such process that writes each segment as a frame; read and checked
                         here, without acknowledgements
  multiprocessing_queue  Python's, between two processes; neither checked nor acknowledged
  zeromq                 the same by pyzmq, PUSH to PULL over ipc://
`peers` are those of 1024 bytes; each of `sizes` has its own. lost and duplicate are found by the
sequence numbers and by what the workers say that they have sent. blocked_cpu_fraction is the share
of a core that a worker uses while nobody takes: queue and outbox are full. What is not to be had is
null or `absent`, with the reason. Ctrl-C ends it at once and leaves nothing.

BETWEEN HOSTS: one end listens, the other connects, both with this version. Segments are of 2048
bytes, policies of half a megabyte. Who listens prints segments_per_s over --seconds, and
policy_ms_median: from publishing a policy until the other host has said that its workers have it.

EXAMPLES
  dmprl bench transport
  dmprl bench transport --workers 2 --rounds 9 --json
  dmprl bench transport --level log        # what that level costs
  dmprl bench transport --listen tcp/0.0.0.0:7448 --seconds 10
  dmprl bench transport --connect tcp/10.0.0.1:7448 --workers 4
  dmprl bench transport --connect tcp/10.0.0.1:7448 --workers 4 --rate 20000
  dmprl bench transport --peer-python /opt/zeromq/bin/python";

/// As `delivery.level`.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Level {
    /// Acknowledged when it is taken.
    Memory,
    /// Acknowledged when it is in the segment log too.
    Log,
}

/// Arguments of `dmprl bench transport`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct TransportArgs {
    /// Processes that send [default: cores - 1]; with --connect 0 for policies alone [default: 1].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=64))]
    workers: Option<u32>,
    /// Delivery level of ours.
    #[arg(long, value_enum, default_value_t = Level::Memory)]
    level: Level,
    /// Python that has pyzmq [default: the one of .venv].
    #[arg(long, value_name = "PATH")]
    peer_python: Option<PathBuf>,
    /// How often each is measured.
    #[arg(long, value_name = "R", default_value_t = 9,
          value_parser = clap::value_parser!(u16).range(1..=1000))]
    rounds: u16,
    /// How long each time [s].
    #[arg(long, value_name = "S", default_value_t = 0.4, value_parser = seconds)]
    seconds: f64,
    /// Measure between hosts: take the learner's place at this Zenoh endpoint.
    #[arg(long, value_name = "ENDPOINT", conflicts_with = "connect")]
    listen: Option<String>,
    /// Measure between hosts: send to who listens at this Zenoh endpoint.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Option<String>,
    /// Segments a second that the workers make together, with --connect [default: what they can].
    #[arg(long, value_name = "N", requires = "connect",
          value_parser = clap::value_parser!(u32).range(1..))]
    rate: Option<u32>,
    /// Zenoh's own configuration (JSON5), with --listen or --connect.
    #[arg(long, value_name = "FILE")]
    zenoh_config: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &TransportArgs) -> anyhow::Result<Outcome> {
    if args.listen.is_some() || args.connect.is_some() {
        return between_hosts(args);
    }
    if args.workers == Some(0) {
        return Err(wrong_use("--workers 0: nobody would send; 0 goes with --connect alone"));
    }
    let peer_python = args.peer_python.as_deref().map(interpreter).transpose()?;
    let (venv, package_path) = python_home()?;
    let default_workers = || u32::try_from(cores().saturating_sub(1)).unwrap_or(1).clamp(1, 64);
    let bench = TransportBench {
        program: this_program()?,
        workers: args.workers.unwrap_or_else(default_workers),
        level: match args.level {
            Level::Memory => DeliveryLevel::Memory,
            Level::Log => DeliveryLevel::Log,
        },
        peer_python: peer_python.unwrap_or_else(|| venv.join("bin/python")),
        package_path,
        rounds: usize::from(args.rounds),
        duration: Duration::from_secs_f64(args.seconds),
    };
    let Some(figures) = bench::transport(&bench)? else { return Ok(Outcome::Interrupted) };
    emit(&if args.json { figures.json().to_string() } else { figures.text() })?;
    Ok(Outcome::Done)
}

fn between_hosts(args: &TransportArgs) -> anyhow::Result<Outcome> {
    let (file, duration) = (args.zenoh_config.as_deref(), Duration::from_secs_f64(args.seconds));
    let figures = match (&args.listen, &args.connect) {
        (Some(endpoint), _) => bench::listen(endpoint, file, duration)?,
        (None, Some(endpoint)) => {
            bench::connect(endpoint, file, (args.workers.unwrap_or(1), args.rate))?
        }
        (None, None) => return Ok(Outcome::Done),
    };
    let Some(figures) = figures else { return Ok(Outcome::Interrupted) };
    let lines = figures.as_object().into_iter().flatten();
    let text = || lines.map(|(key, value)| format!("{key:18} {value}")).collect::<Vec<_>>();
    emit(&if args.json { figures.to_string() } else { text().join("\n") })?;
    Ok(Outcome::Done)
}
