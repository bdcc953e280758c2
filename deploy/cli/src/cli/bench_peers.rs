//! `dmprl bench peers`: builds the benchmark from the command line.

use std::path::PathBuf;

use clap::Args;
use dmprl_bench::{self as bench, AgentKind, AgentsBench};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_shared::config::Limits;
use toml::Value;

use super::bench_values::interpreter;
use super::configuration::{merge, refuse};
use super::configured::{ConfiguredArgs, flag, make_absolute};
use super::{cores, emit, prepare_python, python_home, separate_python, this_program};
use crate::terminal::TerminalProgress;

const HELP: &str = "\
Trains one seed after another with each candidate, in turns, until an evaluation reaches the target.
Without a target, each trains for --max-minutes, and then its last policy is evaluated once.
The time runs from the start of the process, imports included. Ours is a whole `dmprl train`, up to
its end. A peer has one environment, the CPU, and its library's default settings (TD3: with Gaussian
noise of 0.1; sb3-tqc-her: the RL Zoo's), or ours with --equal-settings. All have the same number of
steps before the first update, and the same interval, episodes and seeds of evaluations.
Without --peer-python, the peers' packages are installed into .venv-peers on first use.
Ctrl-C stops the benchmark, removes its processes, and reports the trainings that have ended.

EXAMPLES
  dmprl bench peers --task reacher --until-return -5.2 --preset fast
  dmprl bench peers --task panda-reach-joints --until-success 0.99 --preset fast --seeds 3
  dmprl bench peers --task HalfCheetah-v5 --policy mlp --until-return 3000 --steps 200000 \\
      --max-minutes 60 --peer sb3-td3 --peer sbx-crossq --json
  dmprl bench peers --task pusher --until-return -34 --preset fast --equal-settings
  dmprl bench peers --task panda-push --until-success 0.95 --peer sb3-tqc-her --seeds 1
  dmprl bench peers --task HalfCheetah-v5 --policy mlp --max-minutes 5 --peer sb3-tqc \\
      --peer sbx-crossq --peer sbx-simba --set evaluation.episodes=100";

/// Arguments of `dmprl bench peers`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
#[group(id = "target", multiple = false, args = ["until_return", "until_success"])]
pub(super) struct PeersArgs {
    /// A task of `dmprl tasks`, or a Gymnasium id.
    #[arg(long)]
    task: String,
    #[command(flatten)]
    configured: ConfiguredArgs,
    /// Mean return to reach.
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    until_return: Option<f64>,
    /// Success rate to reach, 0 to 1.
    #[arg(long, value_name = "S")]
    until_success: Option<f64>,
    /// Maximum environment steps of a training [default: the task's with a target, else no limit].
    #[arg(long, value_name = "N")]
    steps: Option<u32>,
    /// Maximum time of a training [min].
    #[arg(long, value_name = "M", default_value_t = 30.0)]
    max_minutes: f64,
    /// Number of seeds, each trained by every candidate.
    #[arg(long, value_name = "N", default_value_t = 5,
          value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Algorithm of another library; repeatable.
    #[arg(long, value_enum, default_values = ["sb3-td3", "sbx-td3"])]
    peer: Vec<AgentKind>,
    /// Give the peers our networks, batch size, learning rate, discount, Polyak factor and updates
    /// per step instead of their libraries' defaults.
    #[arg(long)]
    equal_settings: bool,
    /// Python interpreter with the peers' libraries [default: that of .venv-peers].
    #[arg(long, value_name = "PATH")]
    peer_python: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &PeersArgs) -> anyhow::Result<Outcome> {
    let number = |value: f64| Some(Value::Float(value));
    // The other goal of a configuration file is not one of this benchmark.
    let goal = |value: Option<f64>| number(value.unwrap_or(f64::INFINITY));
    let has_target = args.until_return.is_some() || args.until_success.is_some();
    let steps = args.steps.or((!has_target).then_some(u32::MAX));
    let flags = [
        flag("--until-return", "run.until_return", goal(args.until_return)),
        flag("--until-success", "run.until_success", goal(args.until_success)),
        flag("--max-minutes", "run.max_minutes", number(args.max_minutes)),
        flag("--steps", "run.steps", steps.map(|steps| Value::Integer(steps.into()))),
    ];
    let config = merge(&args.configured.sources(&args.task, flags)?)?;
    let mut config = config.resolve(Limits { cores: cores() }).map_err(refuse)?;
    make_absolute(&mut config)?;
    if !has_target {
        config.evaluation.interval_steps = u32::MAX.into(); // only that of the last policy
    }
    if !config.run.max_minutes.is_finite() {
        return Err(wrong_use("--max-minutes inf: a training that never learns would not end"));
    }
    let targets = [args.until_return, args.until_success];
    if targets.into_iter().flatten().any(|value| !value.is_finite()) {
        return Err(wrong_use("--until-return, --until-success: expected a number, not inf"));
    }
    if config.task.randomise != Default::default() {
        return Err(wrong_use("task.randomise: the peers' environments cannot be randomised"));
    }
    let peer_python = args.peer_python.as_deref().map(interpreter).transpose()?;
    prepare_python()?;
    let mut peers = args.peer.clone();
    peers.sort();
    peers.dedup();
    let root = dmprl_run::project::root()?;
    let peers_path = root.join("tests/peers");
    let bench = AgentsBench {
        program: this_program()?,
        config,
        peers,
        equal_settings: args.equal_settings,
        seeds: args.seeds,
        peer_python: match peer_python {
            Some(python) => python,
            None => separate_python(&root.join(".venv-peers"), &peers_path.join("agents.txt"))?,
        },
        peers_path,
        package_path: python_home()?.1,
    };
    let Some(figures) = bench::agents(&bench, &TerminalProgress::default())? else {
        return Ok(Outcome::Interrupted);
    };
    emit(&if args.json { figures.json().to_string() } else { figures.text() })?;
    Ok(if figures.interrupted { Outcome::Interrupted } else { Outcome::Done })
}
