//! `dmprl bench learner`: builds the benchmark from the command line.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use clap::builder::PossibleValuesParser;
use dmprl_bench::{self as bench, LearnerBench, PeerKind};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_shared::config::{AlgorithmName, Limits, TASKS, task_defaults};
use toml::Value;

use super::bench_values::{interpreter, seconds};
use super::configuration::{merge, refuse};
use super::configured::{ConfiguredArgs, check_build, flag};
use super::{cores, emit};
use crate::terminal::TerminalProgress;

const HELP: &str = "\
In every round each of these runs once for --seconds while the others sleep; the median counts.
  ours            the update of a run, on a replay full of synthetic segments of the task's sizes:
                  it samples a batch and updates every network; no Python, no environment
  floor, ours     only its matrix products, with our kernels, of 16-bit numbers with
                  learner.precision = bf16; several threads share the rows of the batch
  floor, library  the same of 32-bit numbers with the gemm crate; floor_ms is the faster of the two
  processor limit as many multiplications and additions on registers, without memory
  torch, torch-compile, jax
                  the same update in eager PyTorch, or compiled by PyTorch or JAX, on as many
                  cores, with prepared batches (--peer; tests/peers/learner_peer.py). With a peer,
                  no actor has a penalty on changes of actions (algorithm.action_rate_penalty = 0)
With --device cuda, only `ours` runs on the GPU, and samples the next batch meanwhile.
Sampling and optimiser are also measured alone, as shares of the time, and with several threads how
fast a cache line goes from core to core (handover_ns): in a virtual machine it tells whether the
cores share a cache. peak_memory_mb is the learner's (VmHWM), including its replay. Unavailable
figures are null or `absent`, with the reason.
Ctrl-C stops the benchmark and leaves nothing behind.

EXAMPLES
  dmprl bench learner --task pusher
  dmprl bench learner --algo td3 --policy mlp --task reacher --threads 2 --json
  dmprl bench learner --task pusher --peer torch --peer jax --peer-python /opt/torch/bin/python
  dmprl bench learner --task pusher --set algorithm.batch_size=512 --rounds 9
  dmprl bench learner --task pusher --observation-len 1000
  dmprl bench learner --task pusher --device cuda --set algorithm.batch_size=4096 --json";

/// Arguments of `dmprl bench learner`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct LearnerArgs {
    /// A task of `dmprl tasks`, which determines the sizes.
    #[arg(long)]
    task: String,
    #[command(flatten)]
    configured: ConfiguredArgs,
    /// Device of the update; `cuda` needs a build with that feature.
    #[arg(long, value_parser = PossibleValuesParser::new(["cpu", "cuda"]))]
    device: Option<String>,
    /// Threads of the update and of the peers [default: 2, or 1 on one core].
    #[arg(long, value_name = "N")]
    threads: Option<u32>,
    /// Numbers in an observation [default: the task's].
    #[arg(long, value_name = "O", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    observation_len: Option<u32>,
    /// Steps in the replay, unless `replay.capacity_steps` is less.
    #[arg(long, value_name = "N", default_value_t = 100_000,
          value_parser = clap::value_parser!(u32).range(1_000..))]
    replay_steps: u32,
    /// Also measure the update in this library; repeatable.
    #[arg(long, value_enum)]
    peer: Vec<PeerKind>,
    /// Python interpreter with PyTorch or JAX [default: that of .venv].
    #[arg(long, value_name = "PATH")]
    peer_python: Option<PathBuf>,
    /// Number of rounds.
    #[arg(long, value_name = "R", default_value_t = 15,
          value_parser = clap::value_parser!(u16).range(1..=1000))]
    rounds: u16,
    /// Duration of each measurement [s].
    #[arg(long, value_name = "S", default_value_t = 0.4, value_parser = seconds)]
    seconds: f64,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &LearnerArgs) -> anyhow::Result<Outcome> {
    let Some(task) = task_defaults(&args.task) else {
        let names: Vec<_> = TASKS.iter().map(|task| task.name).collect();
        return Err(wrong_use(format!(
            "--task {}: its sizes are not known without Python; expected one of {}",
            args.task,
            names.join(", ")
        )));
    };
    let threads = args.threads.map(|threads| Value::Integer(threads.into()));
    // The peers do not implement our penalties.
    let no_price = (!args.peer.is_empty()).then_some(Value::Float(0.0));
    let flags = [
        flag("--device", "learner.device", args.device.clone().map(Value::String)),
        flag("--threads", "learner.threads", threads),
        flag("--peer", "algorithm.action_rate_penalty", no_price.clone()),
        flag("--peer", "algorithm.action_acceleration_penalty", no_price.clone()),
        flag("--peer", "algorithm.saturation_penalty", no_price),
    ];
    let sources = args.configured.sources(&args.task, flags)?;
    let config = merge(&sources)?.resolve(Limits { cores: cores() }).map_err(refuse)?;
    check_build(&config)?;
    if config.algorithm.name == AlgorithmName::Ndp {
        return Err(wrong_use(
            "--algo ndp: it learns from whole rollouts, not from batches of a replay; expected \
             ddpg, td3, sac or tqc",
        ));
    }
    if config.algorithm.name.is_graph_only() && !args.peer.is_empty() {
        return Err(wrong_use(format!(
            "--peer with --algo {}: the peers have only ddpg, td3 and sac",
            config.algorithm.name.name()
        )));
    }
    let mut peers = args.peer.clone();
    peers.sort();
    peers.dedup();
    let peer_python = args.peer_python.as_deref().map(interpreter).transpose()?;
    let root = dmprl_run::project::root()?;
    let mut spec = task.spec();
    if let Some(len) = args.observation_len {
        spec.observation_len = len as usize;
        spec.observation_names.clear();
    }
    let bench = LearnerBench {
        config,
        spec,
        replay_steps: args.replay_steps as usize,
        peers,
        peer_python: peer_python.unwrap_or_else(|| root.join(".venv/bin/python")),
        peers_path: root.join("tests/peers"),
        rounds: usize::from(args.rounds),
        duration: Duration::from_secs_f64(args.seconds),
    };
    let Some(figures) = bench::learner(bench, &TerminalProgress::default())? else {
        return Ok(Outcome::Interrupted);
    };
    emit(&if args.json { figures.json().to_string() } else { figures.text() })?;
    Ok(Outcome::Done)
}
