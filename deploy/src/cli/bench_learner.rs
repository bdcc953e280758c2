//! `dmprl bench learner`: from the command line to the benchmark.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use dmprl_shared::config::{AlgorithmName, Limits, TASKS, task_defaults};
use toml::Value;

use super::bench::{interpreter, seconds};
use super::configuration::{merge, refuse};
use super::configured::{ConfiguredArgs, flag};
use super::{cores, emit};
use crate::bench::{self, LearnerBench, PeerKind};
use crate::failure::{Outcome, wrong_use};

const HELP: &str = "\
In every round each of these runs once for --seconds, the others asleep; the median counts.
  ours            the update of a run, on a replay full of made-up segments of the task's sizes:
                  it samples a batch and moves every network; no Python, no environment
  floor, ours     its matrix products and nothing else, by our kernels; with several threads each
                  has its share of the batch's rows
  floor, library  the same by the gemm crate; the faster of the two is floor_ms
  torch, jax      the same update in eager PyTorch, or compiled by JAX, on as many cores, with
                  batches at hand; asked for with --peer, run by tests/peers/learner_peer.py; then
                  nobody's actor pays for changes of actions (algorithm.action_rate_penalty = 0)
Sampling and optimiser are measured alone too: the shares of the time. peak_memory_mb is the
learner's (VmHWM), its replay included. What is not to be had is null or `absent`, with the reason.
Ctrl-C ends it and leaves nothing.

EXAMPLES
  dmprl bench learner --task pusher
  dmprl bench learner --algo td3 --policy mlp --task reacher --threads 2 --json
  dmprl bench learner --task pusher --peer torch --peer jax --peer-python /opt/torch/bin/python
  dmprl bench learner --task pusher --set algorithm.batch_size=512 --rounds 9";

/// Arguments of `dmprl bench learner`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct LearnerArgs {
    /// A task of `dmprl tasks`, for its sizes.
    #[arg(long)]
    task: String,
    #[command(flatten)]
    configured: ConfiguredArgs,
    /// Threads of the update, and of whom it is compared with.
    #[arg(long, value_name = "N")]
    threads: Option<u32>,
    /// Who else does the update; repeatable.
    #[arg(long, value_enum)]
    peer: Vec<PeerKind>,
    /// Python that has PyTorch or JAX [default: the one of .venv].
    #[arg(long, value_name = "PATH")]
    peer_python: Option<PathBuf>,
    /// How often each is measured.
    #[arg(long, value_name = "R", default_value_t = 15,
          value_parser = clap::value_parser!(u16).range(1..=1000))]
    rounds: u16,
    /// How long each time [s].
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
    // A price of ours, which others do not know.
    let no_price = (!args.peer.is_empty()).then_some(Value::Float(0.0));
    let flags = [
        flag("--threads", "learner.threads", threads),
        flag("--peer", "algorithm.action_rate_penalty", no_price),
    ];
    let sources = args.configured.sources(&args.task, flags)?;
    let config = merge(&sources)?.resolve(Limits { cores: cores() }).map_err(refuse)?;
    if config.algorithm.name == AlgorithmName::Ndp {
        return Err(wrong_use(
            "--algo ndp: it learns from whole rollouts, not from batches of a replay; expected \
             ddpg, td3 or sac",
        ));
    }
    let mut peers = args.peer.clone();
    peers.sort();
    peers.dedup();
    let peer_python = args.peer_python.as_deref().map(interpreter).transpose()?;
    let root = crate::project::root()?;
    let bench = LearnerBench {
        config,
        spec: bench::spec_of(task),
        peers,
        peer_python: peer_python.unwrap_or_else(|| root.join(".venv/bin/python")),
        peers_path: root.join("tests/peers"),
        rounds: usize::from(args.rounds),
        duration: Duration::from_secs_f64(args.seconds),
    };
    let Some(figures) = bench::learner(bench)? else { return Ok(Outcome::Interrupted) };
    emit(&if args.json { figures.json().to_string() } else { figures.text() })?;
    Ok(Outcome::Done)
}
