//! `dmprl bench transport`: builds the benchmark from the command line.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};
use dmprl_bench::{self as bench, TransportBench};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_shared::config::DeliveryLevel;

use super::bench_values::{interpreter, seconds};
use super::{cores, emit, python_home, python_of, this_program};
use crate::terminal::TerminalProgress;

const HELP: &str = "\
For segments of 1024 and of 10240 bytes. In every round each of these runs once for --seconds while
the others sleep; the median counts.
  shared_memory          worker processes that only send, with the code of a run's workers:
                         checksum, outbox, queue, acknowledgements. This process takes, checks,
                         settles and acknowledges the segments instead of a learner; at --level log
                         it first appends them to a segment log in the folder for temporary files
  pipe, unix_socket      one such process, which writes each segment as a frame; read and checked
                         here, without acknowledgements
  multiprocessing_queue  Python's, between two processes; neither checked nor acknowledged
  zeromq                 the same with pyzmq, PUSH to PULL over ipc://
`peers` are measured with 1024 bytes; each of `sizes` has its own. lost and duplicate come from the
sequence numbers and from the number of segments that the workers report as sent.
blocked_cpu_fraction is the share of a core that a worker uses while queue and outbox are full.
Unavailable figures are null or `absent`, with the reason. Ctrl-C stops the benchmark at once and
leaves nothing behind.

BETWEEN HOSTS: one end listens, the other connects, both with this version. Segments have 2048
bytes, policies half a megabyte. The listening end prints segments_per_s over --seconds, and
policy_ms_median: from publishing a policy until the other host reports that its workers have it.

EXAMPLES
  dmprl bench transport
  dmprl bench transport --workers 2 --rounds 9 --json
  dmprl bench transport --level log        # the cost of this level
  dmprl bench transport --listen tls/0.0.0.0:7448 --seconds 10
  dmprl bench transport --connect tls/10.0.0.1:7448 --workers 4
  dmprl bench transport --connect tls/10.0.0.1:7448 --workers 4 --rate 20000
  dmprl bench transport --peer-python /opt/zeromq/bin/python";

/// Delivery level, as in `delivery.level`.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Level {
    /// Acknowledges a segment when it is taken.
    Memory,
    /// Acknowledges a segment when it is also in the segment log.
    Log,
}

/// Arguments of `dmprl bench transport`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct TransportArgs {
    /// Sending processes [default: cores - 1, with --connect 1]; 0 with --connect sends none and
    /// measures policies alone.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=64))]
    workers: Option<u32>,
    /// Delivery level of the shared-memory transport.
    #[arg(long, value_enum, default_value_t = Level::Memory)]
    level: Level,
    /// Python interpreter with pyzmq [default: that of .venv].
    #[arg(long, value_name = "PATH")]
    peer_python: Option<PathBuf>,
    /// Number of rounds.
    #[arg(long, value_name = "R", default_value_t = 9,
          value_parser = clap::value_parser!(u16).range(1..=1000))]
    rounds: u16,
    /// Duration of each measurement [s].
    #[arg(long, value_name = "S", default_value_t = 0.4, value_parser = seconds)]
    seconds: f64,
    /// Measure between hosts: act as the learner at this Zenoh endpoint.
    #[arg(long, value_name = "ENDPOINT", conflicts_with = "connect")]
    listen: Option<String>,
    /// Measure between hosts: send to the listener at this Zenoh endpoint.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Option<String>,
    /// Total segments per second of all workers, with --connect [default: unlimited].
    #[arg(long, value_name = "N", requires = "connect",
          value_parser = clap::value_parser!(u32).range(1..))]
    rate: Option<u32>,
    /// Zenoh configuration file (JSON5), with --listen or --connect.
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
        return Err(wrong_use("--workers 0: no process would send; 0 needs --connect"));
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
        peer_python: peer_python.unwrap_or_else(|| python_of(&venv)),
        package_path,
        rounds: usize::from(args.rounds),
        duration: Duration::from_secs_f64(args.seconds),
    };
    let Some(figures) = bench::transport(&bench, &TerminalProgress::default())? else {
        return Ok(Outcome::Interrupted);
    };
    emit(&if args.json { figures.json().to_string() } else { figures.text() })?;
    Ok(Outcome::Done)
}

fn between_hosts(args: &TransportArgs) -> anyhow::Result<Outcome> {
    let (file, duration) = (args.zenoh_config.as_deref(), Duration::from_secs_f64(args.seconds));
    let figures = match (&args.listen, &args.connect) {
        (Some(endpoint), _) => bench::listen(endpoint, file, duration)?,
        (None, Some(endpoint)) => {
            bench::connect(endpoint, file, args.workers.unwrap_or(1), args.rate)?
        }
        (None, None) => return Ok(Outcome::Done),
    };
    let Some(figures) = figures else { return Ok(Outcome::Interrupted) };
    let lines = figures.as_object().into_iter().flatten();
    let text = || lines.map(|(key, value)| format!("{key:18} {value}")).collect::<Vec<_>>();
    emit(&if args.json { figures.to_string() } else { text().join("\n") })?;
    Ok(Outcome::Done)
}
