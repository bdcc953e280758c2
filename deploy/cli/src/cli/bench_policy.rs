//! `dmprl bench policy`: builds the benchmark from the command line.

use std::path::PathBuf;

use clap::Args;
use dmprl_analysis::export::read_policy;
use dmprl_bench::{self as bench, PolicyBench};
use dmprl_run::PolicyChoice;
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_shared::config::{Limits, TASKS, task_defaults};
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::policy::Policy;
use dmprl_shared::policy_file::{self, OpenedPolicy};
use dmprl_shared::seeds;

use super::bench_values::interpreter;
use super::configuration::{merge, refuse};
use super::configured::ConfiguredArgs;
use super::{cores, emit, open_run, prepare_python, python_home, python_of};

const HELP: &str = "\
One observation at a time, on one core, as on a robot. In every round each of these makes --calls
calls; all calls of all rounds count.
  decision   from an observation to the actions of a segment, with dmprl-runtime
  action     one control step of the same; one in K control steps makes a decision
  numpy      the decision by dmprl.Policy, from the file that `dmprl export` writes
  onnx       the decision by onnxruntime, if the interpreter has it
Ctrl-C stops the benchmark at once and leaves nothing behind.

EXAMPLES
  dmprl bench policy runs/mine
  dmprl bench policy reacher.safetensors --json
  dmprl bench policy --task pusher --policy mlp
  dmprl bench policy --task reacher --peer-python /opt/onnx/bin/python";

/// Arguments of `dmprl bench policy`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct PolicyArgs {
    /// A run directory or zoo:TASK, for its best policy, or a file of `dmprl export`.
    #[arg(required_unless_present = "task", conflicts_with = "task")]
    run: Option<PathBuf>,
    /// Use an untrained policy for this task of `dmprl tasks`.
    #[arg(long)]
    task: Option<String>,
    #[command(flatten)]
    configured: ConfiguredArgs,
    /// Calls per round.
    #[arg(long, value_name = "N", default_value_t = 2_000,
          value_parser = clap::value_parser!(u32).range(10..=20_000))]
    calls: u32,
    /// Number of rounds.
    #[arg(long, value_name = "R", default_value_t = 5,
          value_parser = clap::value_parser!(u16).range(1..=1000))]
    rounds: u16,
    /// Python interpreter with onnxruntime [default: that of .venv].
    #[arg(long, value_name = "PATH")]
    peer_python: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &PolicyArgs) -> anyhow::Result<Outcome> {
    let opened = opened(args)?;
    let peer_python = args.peer_python.as_deref().map(interpreter).transpose()?;
    let python = match peer_python {
        Some(python) => python,
        None => python_of(&prepare_python()?),
    };
    let bench = PolicyBench {
        opened,
        python,
        package_path: python_home()?.1,
        rounds: usize::from(args.rounds),
        calls: args.calls as usize,
    };
    let Some(figures) = bench::policy(&bench)? else { return Ok(Outcome::Interrupted) };
    emit(&if args.json { figures.json().to_string() } else { figures.text() })?;
    Ok(Outcome::Done)
}

fn opened(args: &PolicyArgs) -> anyhow::Result<OpenedPolicy> {
    if let Some(path) = &args.run {
        if !args.configured.is_empty() {
            return Err(wrong_use(format!(
                "{}: the policy is already configured; flags of a configuration go with --task",
                path.display()
            )));
        }
        if path.is_file() {
            return Ok(policy_file::open(path)?);
        }
        let run = open_run(path)?;
        return read_policy(&run, &run.choose_policy(PolicyChoice::Best)?);
    }
    let name = args.task.as_deref().unwrap_or_default();
    let Some(task) = task_defaults(name) else {
        let names: Vec<_> = TASKS.iter().map(|task| task.name).collect();
        return Err(wrong_use(format!(
            "--task {name}: its sizes are not known without Python; expected one of {}",
            names.join(", ")
        )));
    };
    let sources = args.configured.sources(name, [])?;
    let config = merge(&sources)?.resolve(Limits { cores: cores() }).map_err(refuse)?;
    let policy = Policy::new(config.policy_description(&task.spec()))?;
    let values = policy.initial_parameters(&mut seeds::stream(config.run.seed, "policy", 0));
    let architecture_hash = policy.architecture_hash();
    let snapshot =
        ParameterSnapshot { version: 0, env_steps: 0, architecture_hash, settled: false, values };
    Ok(OpenedPolicy { policy, snapshot, origin: None, hold: None })
}
