//! Command lines of the roles. The supervisor starts the roles; a user can start one to inspect it.

use std::path::PathBuf;

use clap::Args;
use dmprl_shared::config::Execution;

const LEARNER_HELP: &str = "\
Exchanges JSON lines with the supervisor on standard input and output; logs to standard error.
When its standard input ends, it writes a checkpoint and exits.

EXAMPLES
  dmprl learner --run runs/mine --domain /dev/shm/dmprl-1000/4f2a
  dmprl learner --run runs/mine --one-process   # what `train --deterministic` starts";

const ACTOR_HELP: &str = "\
With --join, this worker joins a run that this user trains on this machine. A run accepts up to
actors.joined_max such workers. On the first Ctrl-C it delivers its segments and leaves (status
130); a second Ctrl-C ends it at once. It also ends with the run.

Without --join, it is a worker as `train` starts it: it exchanges JSON lines with the supervisor on
standard input and output, logs to standard error, reports its environment, waits for `attach`, and
exits when its standard input ends.

EXAMPLES
  dmprl actor --join runs/mine
  dmprl actor --run runs/mine --index 0 --incarnation 0   # what `train` starts";

const GATEWAY_HELP: &str = "\
Exchanges JSON lines with the supervisor on standard input and output; logs to standard error.
Listens at bridge.listen for other hosts. Exits when its standard input ends.

EXAMPLES
  dmprl gateway --run runs/mine --domain /dev/shm/dmprl-1000/4f2a   # what `train` starts";

const RELAY_HELP: &str = "\
Exchanges JSON lines with the supervisor on standard input and output; logs to standard error.
Acts as the learner for the workers of its host. Exits when its standard input ends.

EXAMPLES
  dmprl bridge --connect tls/10.0.0.1:7447 --token-file bridge.token --workers 4   # starts one";

const EVALUATOR_HELP: &str = "\
Exchanges JSON lines with the supervisor on standard input and output; logs to standard error.
Answers each `evaluate` with a row. Exits when its standard input ends.

EXAMPLES
  dmprl evaluator --run runs/mine
  dmprl evaluator --run runs/mine --print-only --episodes 100   # what `eval` starts";

const OBSERVER_HELP: &str = "\
Exchanges JSON lines with its parent on standard input and output; logs to standard error. Writes
one JSON object per line: the robot, then each episode. Exits when its standard input ends.

EXAMPLES
  dmprl observer --run runs/mine --policy 4120 --first-seed 1000 --episodes 20 --output e.jsonl";

/// Arguments of `dmprl learner`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = LEARNER_HELP)]
pub struct LearnerArgs {
    /// Run directory.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// Private shared-memory directory of the run.
    #[arg(long, value_name = "DIR", required_unless_present = "one_process")]
    pub domain: Option<PathBuf>,
    /// Resume from `checkpoints/latest`.
    #[arg(long)]
    pub resume: bool,
    /// Step, update and evaluate in lock-step in this process, without workers and evaluator.
    #[arg(long, conflicts_with = "domain")]
    pub one_process: bool,
    /// Number of restarts of the learner after a crash in the whole run, including this start.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub restarts: u64,
    /// Start from the parameters of this policy file.
    #[arg(long, value_name = "FILE")]
    pub init_from: Option<PathBuf>,
    /// Python virtual environment (with --one-process).
    #[arg(long, value_name = "DIR")]
    pub venv: Option<PathBuf>,
    /// Write a journal of segments and policies to this folder, for `dmprl chaos`.
    #[arg(long, value_name = "DIR", hide = true)]
    pub journal: Option<PathBuf>,
}

/// Arguments of `dmprl actor`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = ACTOR_HELP)]
pub struct ActorArgs {
    /// Join this run, which must be training.
    #[arg(long, value_name = "RUN", conflicts_with_all = ["run", "index", "incarnation", "venv"])]
    pub join: Option<PathBuf>,
    /// Run directory.
    #[arg(long, value_name = "DIR", required_unless_present = "join")]
    pub run: Option<PathBuf>,
    /// Index of the worker, from 0.
    #[arg(long, value_name = "I", required_unless_present = "join")]
    pub index: Option<u32>,
    /// Number of this start of the worker, over all sessions of the run; never used twice.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub incarnation: u32,
    /// Python virtual environment.
    #[arg(long, value_name = "DIR")]
    pub venv: Option<PathBuf>,
    /// Write a journal of segments and policies to this folder, for `dmprl chaos`.
    #[arg(long, value_name = "DIR", hide = true)]
    pub journal: Option<PathBuf>,
    /// On a host without a learner: index in the run of its first worker.
    #[arg(long, value_name = "I", default_value_t = 0)]
    pub first: u32,
}

/// Arguments of `dmprl gateway`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = GATEWAY_HELP)]
pub struct GatewayArgs {
    /// Run directory.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// Private shared-memory directory of the run.
    #[arg(long, value_name = "DIR")]
    pub domain: PathBuf,
    /// Number of this session of the run, from 0.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub session: u32,
}

/// Arguments of `dmprl relay`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = RELAY_HELP)]
pub struct RelayArgs {
    /// Directory of the run on this host.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// Private shared-memory directory of this host.
    #[arg(long, value_name = "DIR")]
    pub domain: PathBuf,
    /// Zenoh endpoint of the learner's host.
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: String,
    /// File with the run's token.
    #[arg(long, value_name = "FILE")]
    pub token_file: PathBuf,
    /// Name of this host, for display.
    #[arg(long)]
    pub name: String,
    /// Random number that identifies this start of `dmprl bridge`.
    #[arg(long, value_name = "N")]
    pub host: u64,
    /// Index in the run of this host's first worker.
    #[arg(long, value_name = "I")]
    pub first: u32,
    /// Session of the run from which the incarnations of its workers are derived.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub session: u32,
    /// How long to wait while the learner's host is unreachable, in seconds.
    #[arg(long, value_name = "S")]
    pub patience: u64,
    /// Zenoh configuration file (JSON5), for certificates.
    #[arg(long, value_name = "FILE")]
    pub zenoh_config: Option<PathBuf>,
}

/// Arguments of `dmprl evaluator`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = EVALUATOR_HELP)]
pub struct EvaluatorArgs {
    /// Run directory.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// Report rows without appending them to `evaluations.jsonl`.
    #[arg(long)]
    pub print_only: bool,
    /// Number of episodes per evaluation, instead of `evaluation.episodes`.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub episodes: Option<u64>,
    /// Table instead of `task.randomise`.
    #[arg(long, value_name = "TOML")]
    pub randomise: Option<String>,
    /// Execution instead of `policy.execution`.
    #[arg(long, value_name = "segment|ensemble")]
    pub execution: Option<Execution>,
    /// Python virtual environment.
    #[arg(long, value_name = "DIR")]
    pub venv: Option<PathBuf>,
}

/// Arguments of `dmprl observer`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = OBSERVER_HELP)]
pub struct ObserverArgs {
    /// Run directory.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// Version of the saved policy.
    #[arg(long, value_name = "VERSION")]
    pub policy: u64,
    /// Seed of the first episode; episode i has seed first-seed + i.
    #[arg(long, value_name = "S")]
    pub first_seed: u64,
    /// Number of episodes.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub episodes: u64,
    /// File to write.
    #[arg(long, value_name = "FILE")]
    pub output: PathBuf,
    /// Also draw frames into this folder.
    #[arg(long, value_name = "DIR")]
    pub pictures: Option<PathBuf>,
    /// Also write observations, commands and segments.
    #[arg(long)]
    pub details: bool,
    /// Python virtual environment.
    #[arg(long, value_name = "DIR")]
    pub venv: Option<PathBuf>,
}
