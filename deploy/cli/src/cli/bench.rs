//! `dmprl bench`: measures a part of the system and compares it with alternatives.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use dmprl_bench::{self as bench, Controls, RolloutBench};
use dmprl_run::failure::Outcome;
use dmprl_shared::config::Limits;

use super::bench_learner::{self, LearnerArgs};
use super::bench_peers::{self, PeersArgs};
use super::bench_policy::{self, PolicyArgs};
use super::bench_scale::{self, ScaleArgs};
use super::bench_system::{self, SystemArgs};
use super::bench_transport::{self, TransportArgs};
use super::bench_values::{interpreter, seconds};
use super::configuration::{merge, refuse};
use super::configured::{ConfiguredArgs, make_absolute};
use super::{cores, emit, prepare_python, python_home, python_of, this_program};
use crate::terminal::TerminalProgress;

/// Queue length in segments per environment, unless configured. It lets the receiver sleep while a
/// worker works. A run's learner does not sleep while it has updates to do.
const QUEUED_SEGMENTS: usize = 4;

const HELP: &str = "\
EXAMPLES
  dmprl bench rollout --task reacher
  dmprl bench learner --task pusher --threads 1
  dmprl bench transport
  dmprl bench policy runs/mine
  dmprl bench system --task reacher
  dmprl bench peers --task reacher --until-return -5.2
  dmprl bench scale
  dmprl bench learner --help";

const ROLLOUT_HELP: &str = "\
In every round each of these runs once for --seconds while the others sleep; the median counts.
  mujoco     mujoco.batch alone, as imported, on Gymnasium's model file if there is one
  ceiling    mujoco.batch alone, with the workers' own model and process settings: the bound
             (both replay recorded controls, see --controls)
  worker     `dmprl actor` processes as in a run: network, movement primitives, noise,
             environments, shared memory; this process receives the segments instead of a learner.
             Each queue holds four segments per environment (a run's default: one), so that the
             result does not depend on the receiver's sleep
  one worker the first worker alone, while the others wait with full queues
  gymnasium  a loop over Gymnasium environments, with the same policy in NumPy
  envpool    EnvPool with one thread per worker, with the same policy in NumPy
  panda-gym  for the two Panda tasks: a loop over panda-gym's own, random actions, no policy
All but the workers use one Python process per worker. Unavailable figures are null or `absent`,
with the reason. worker_rss_mb is the peak resident memory of a worker (VmHWM); first_segment_s is
the time from the start of the slowest worker to its first delivered segment.
Ctrl-C stops the benchmark at once and leaves nothing behind.

EXAMPLES
  dmprl bench rollout --task reacher
  dmprl bench rollout --task pusher --workers 4 --envs-per-worker 16 --json
  dmprl bench rollout --task reacher --policy mlp --rounds 9 --seconds 2
  dmprl bench rollout --task reacher --set policy.segment_steps=10
  dmprl bench rollout --task reacher --peer-python /opt/envpool/bin/python";

/// Arguments of `dmprl bench`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct BenchArgs {
    #[command(subcommand)]
    bench: Bench,
}

#[derive(Debug, Subcommand)]
enum Bench {
    /// Measure the time of an update, and compare it with its matrix products, PyTorch and JAX.
    Learner(Box<LearnerArgs>),
    /// Measure the time until a policy reaches a return or success rate, and compare it with other
    /// libraries.
    Peers(Box<PeersArgs>),
    /// Measure the time of a decision of an exported policy, and compare it with NumPy and
    /// onnxruntime.
    Policy(Box<PolicyArgs>),
    /// Measure environment steps per second of the workers, and compare them with other simulators.
    Rollout(Box<RolloutArgs>),
    /// Measure a learner with 256 synthetic workers, and predict the throughput of up to 1024.
    Scale(Box<ScaleArgs>),
    /// Measure steps and updates per second of a complete training run.
    System(Box<SystemArgs>),
    /// Measure segments per second from workers to learner, and compare them with pipes, sockets
    /// and Python's queues.
    Transport(TransportArgs),
}

/// Arguments of `dmprl bench rollout`.
#[derive(Debug, Args)]
#[command(after_help = ROLLOUT_HELP)]
struct RolloutArgs {
    /// A task of `dmprl tasks`, a Gymnasium id, or your own class.
    #[arg(long)]
    task: String,
    #[command(flatten)]
    configured: ConfiguredArgs,
    /// Number of rounds.
    #[arg(long, value_name = "R", default_value_t = 15,
          value_parser = clap::value_parser!(u16).range(1..=1000))]
    rounds: u16,
    /// Duration of each measurement [s].
    #[arg(long, value_name = "S", default_value_t = 0.4, value_parser = seconds)]
    seconds: f64,
    /// Controls for the physics alone: recorded from the policy, or random actions.
    #[arg(long, value_enum, default_value_t = Controls::Policy)]
    controls: Controls,
    /// Python interpreter with EnvPool or panda-gym [default: that of .venv].
    #[arg(long, value_name = "PATH")]
    peer_python: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &BenchArgs) -> anyhow::Result<Outcome> {
    match &args.bench {
        Bench::Learner(args) => bench_learner::run(args),
        Bench::Peers(args) => bench_peers::run(args),
        Bench::Policy(args) => bench_policy::run(args),
        Bench::Rollout(args) => rollout(args),
        Bench::Scale(args) => bench_scale::run(args),
        Bench::System(args) => bench_system::run(args),
        Bench::Transport(args) => bench_transport::run(args),
    }
}

fn rollout(args: &RolloutArgs) -> anyhow::Result<Outcome> {
    let mut config = merge(&args.configured.sources(&args.task, [])?)?;
    if config.actors.queue_segments == 0 {
        config.actors.queue_segments = QUEUED_SEGMENTS * config.actors.envs_per_worker;
    }
    let mut config = config.resolve(Limits { cores: cores() }).map_err(refuse)?;
    make_absolute(&mut config)?;
    let peer_python = args.peer_python.as_deref().map(interpreter).transpose()?;
    let venv = prepare_python()?;
    let bench = RolloutBench {
        program: this_program()?,
        config,
        peer_python: peer_python.unwrap_or_else(|| python_of(&venv)),
        controls: args.controls,
        venv,
        package_path: python_home()?.1,
        rounds: usize::from(args.rounds),
        duration: Duration::from_secs_f64(args.seconds),
    };
    let Some(figures) = bench::rollout(bench, &TerminalProgress::default())? else {
        return Ok(Outcome::Interrupted);
    };
    emit(&if args.json { figures.json().to_string() } else { figures.text() })?;
    Ok(Outcome::Done)
}
