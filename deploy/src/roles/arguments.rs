//! The roles' command lines. The supervisor writes them; a person may, to look at one process.

use std::path::PathBuf;

use clap::Args;

const LEARNER_HELP: &str = "\
Speaks JSON lines with the supervisor on standard input and output; logs to standard error.
Ends after a checkpoint when its standard input ends.

EXAMPLES
  dmprl learner --run runs/mine --domain /dev/shm/dmprl-1000/4f2a
  dmprl learner --run runs/mine --one-process   # what `train --deterministic` starts";

const ACTOR_HELP: &str = "\
With --join, it joins a run that this user trains on this machine, up to the run's
actors.joined_max. The first Ctrl-C lets it hand over what it has and leave (status 130), the
second ends it at once; it also ends with the run. Without, it is one that `train` starts: speaks
JSON lines with the supervisor on standard input and output, logs to standard error, reports its
environment, then waits for `attach`, and ends when its standard input ends.

EXAMPLES
  dmprl actor --join runs/mine
  dmprl actor --run runs/mine --index 0 --incarnation 0   # what `train` starts";

const GATEWAY_HELP: &str = "\
Speaks JSON lines with the supervisor on standard input and output; logs to standard error.
Listens at bridge.listen for other hosts. Ends when its standard input ends.

EXAMPLES
  dmprl gateway --run runs/mine --domain /dev/shm/dmprl-1000/4f2a   # what `train` starts";

const RELAY_HELP: &str = "\
Speaks JSON lines with the supervisor on standard input and output; logs to standard error.
To the workers of its host it is the learner. Ends when its standard input ends.

EXAMPLES
  dmprl bridge --connect tcp/10.0.0.1:7447 --token-file bridge.token --workers 4   # starts one";

const EVALUATOR_HELP: &str = "\
Speaks JSON lines with the supervisor on standard input and output; logs to standard error.
Answers each `evaluate` with a row. Ends when its standard input ends.

EXAMPLES
  dmprl evaluator --run runs/mine
  dmprl evaluator --run runs/mine --print-only --episodes 100   # what `eval` starts";

const OBSERVER_HELP: &str = "\
Speaks JSON lines with whoever started it on standard input and output; logs to standard error.
Writes one JSON object a line: the robot, then each episode. Ends when its standard input ends.

EXAMPLES
  dmprl observer --run runs/mine --policy 4120 --first-seed 1000 --episodes 20 --output e.jsonl";

/// Arguments of `dmprl learner`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = LEARNER_HELP)]
pub struct LearnerArgs {
    /// The run directory.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// The run's private shared-memory directory.
    #[arg(long, value_name = "DIR", required_unless_present = "one_process")]
    pub domain: Option<PathBuf>,
    /// Go on from `checkpoints/latest`.
    #[arg(long)]
    pub resume: bool,
    /// Be the only process: step, update and evaluate in lock-step, with neither workers nor
    /// evaluator.
    #[arg(long, conflicts_with = "domain")]
    pub one_process: bool,
    /// Starts of the learner after a death within a session, over the whole run, this one included.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub restarts: u64,
    /// Start from the parameters of this policy file.
    #[arg(long, value_name = "FILE")]
    pub init_from: Option<PathBuf>,
    /// The Python virtual environment (with --one-process).
    #[arg(long, value_name = "DIR")]
    pub venv: Option<PathBuf>,
    /// Note in a file of this folder what comes and goes; `dmprl chaos` reads it.
    #[arg(long, value_name = "DIR", hide = true)]
    pub journal: Option<PathBuf>,
}

/// Arguments of `dmprl actor`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = ACTOR_HELP)]
pub struct ActorArgs {
    /// Join this run, which is being trained.
    #[arg(long, value_name = "RUN", conflicts_with_all = ["run", "index", "incarnation", "venv"])]
    pub join: Option<PathBuf>,
    /// The run directory.
    #[arg(long, value_name = "DIR", required_unless_present = "join")]
    pub run: Option<PathBuf>,
    /// Which of the run's workers, from 0.
    #[arg(long, value_name = "I", required_unless_present = "join")]
    pub index: Option<u32>,
    /// Counts this worker's starts over all sessions of the run; never given twice.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub incarnation: u32,
    /// The Python virtual environment.
    #[arg(long, value_name = "DIR")]
    pub venv: Option<PathBuf>,
    /// Note in a file of this folder what comes and goes; `dmprl chaos` reads it.
    #[arg(long, value_name = "DIR", hide = true)]
    pub journal: Option<PathBuf>,
    /// On a host that has no learner: which of the run's workers its first is.
    #[arg(long, value_name = "I", default_value_t = 0)]
    pub first: u32,
}

/// Arguments of `dmprl gateway`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = GATEWAY_HELP)]
pub struct GatewayArgs {
    /// The run directory.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// The run's private shared-memory directory.
    #[arg(long, value_name = "DIR")]
    pub domain: PathBuf,
    /// Which session of the run this is, from 0.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub session: u32,
}

/// Arguments of `dmprl relay`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = RELAY_HELP)]
pub struct RelayArgs {
    /// This host's directory of the run.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// This host's private shared-memory directory.
    #[arg(long, value_name = "DIR")]
    pub domain: PathBuf,
    /// The Zenoh endpoint of the learner's host.
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: String,
    /// File with the run's secret.
    #[arg(long, value_name = "FILE")]
    pub token_file: PathBuf,
    /// What people call this host.
    #[arg(long)]
    pub name: String,
    /// Tells this start of `dmprl bridge` from every other.
    #[arg(long, value_name = "N")]
    pub host: u64,
    /// Which of the run's workers the first of this host is.
    #[arg(long, value_name = "I")]
    pub first: u32,
    /// Its workers' incarnations are counted as in this session of the run.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub session: u32,
    /// How long the learner's host may be away, in seconds.
    #[arg(long, value_name = "S")]
    pub patience: u64,
    /// Zenoh's own configuration: certificates.
    #[arg(long, value_name = "FILE")]
    pub zenoh_config: Option<PathBuf>,
}

/// Arguments of `dmprl evaluator`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = EVALUATOR_HELP)]
pub struct EvaluatorArgs {
    /// The run directory.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// Report rows without appending them to `evaluations.jsonl`.
    #[arg(long)]
    pub print_only: bool,
    /// Episodes of each evaluation instead of `evaluation.episodes`.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub episodes: Option<u64>,
    /// The Python virtual environment.
    #[arg(long, value_name = "DIR")]
    pub venv: Option<PathBuf>,
}

/// Arguments of `dmprl observer`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = OBSERVER_HELP)]
pub struct ObserverArgs {
    /// The run directory.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// Version of the saved policy.
    #[arg(long, value_name = "VERSION")]
    pub policy: u64,
    /// Episode i is reset with seed first-seed + i.
    #[arg(long, value_name = "S")]
    pub first_seed: u64,
    /// Episodes.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub episodes: u64,
    /// The file to write.
    #[arg(long, value_name = "FILE")]
    pub output: PathBuf,
    /// Draw frames into this folder, too.
    #[arg(long, value_name = "DIR")]
    pub pictures: Option<PathBuf>,
    /// The Python virtual environment.
    #[arg(long, value_name = "DIR")]
    pub venv: Option<PathBuf>,
}
