//! The command line: its commands, their help, and the dispatch to their implementations.

mod attended;
mod bench;
mod bench_learner;
mod bench_peers;
mod bench_policy;
mod bench_scale;
mod bench_system;
mod bench_transport;
mod bench_values;
mod bridge;
mod chaos;
mod clean;
mod completions;
mod configuration;
mod configured;
mod dashboard;
mod demos;
mod doctor;
mod env;
mod eval;
mod export;
mod hub;
mod output;
mod play;
mod pull;
mod push;
mod record;
mod report;
mod resume;
mod search;
mod session;
mod sweep;
mod tasks;
mod train;
mod trust;

use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Parser, Subcommand};
use dmprl_bench::{SegmentFeederArgs, TransportWorkerArgs, segment_feeder, transport_worker};
use dmprl_run::failure::{Outcome, exit_status, render, wrong_use};
use dmprl_run::{RunDirectory, Session, Zoo};
use dmprl_shared::config::ExperimentConfig;

use crate::roles::{
    self, ActorArgs, EvaluatorArgs, GatewayArgs, LearnerArgs, ObserverArgs, RelayArgs,
};
use crate::terminal::ProgressStyle;
#[cfg(feature = "python")]
use crate::terminal::TerminalProgress;
use crate::terminal::messages::{self, MessageStyle};
pub use dmprl_run::PANIC_STATUS;
#[cfg(feature = "python")]
use dmprl_run::Progress;
#[cfg(feature = "python")]
use dmprl_supervisor::python_setup::{
    Home, PythonEnvironment, ensure_extra, ensure_separate, packages,
};
use session::name_limits;
pub use session::{TrainingPlan, train_session};

const EXAMPLES: &str = "\
EXAMPLES
  dmprl train reacher                      train with the defaults
  dmprl eval runs/reacher-td3-dmp-s1-…    evaluate its best policy
  dmprl resume runs/reacher-td3-dmp-s1-…  continue from the last checkpoint
  dmprl actor --join runs/reacher-td3-…   add a worker to a run that is training
  dmprl bridge --connect tls/10.0.0.1:7447 --token-file bridge.token   add another host's workers
  dmprl record runs/reacher-td3-dmp-s1-…  record a video of its best policy
  dmprl dashboard                          watch all runs in a browser
  dmprl tasks                              list the built-in tasks
  dmprl doctor                             check this machine

See `dmprl COMMAND --help` for details. Exit status: 0 success, 1 failure, 2 usage error,
130 interrupted.";

const ROLES: &str = "\
ROLES (train starts them; each has --help)
  learner    stores segments in a replay, updates and publishes policies, writes checkpoints
  actor      steps environments and sends segments
  evaluator  evaluates saved policies without noise
  observer   records every step of a saved policy's episodes
  gateway    receives the segments of workers on other hosts
  relay      forwards segments and policies on a host without a learner (started by bridge)

";

/// Trains DMP policies for robot manipulation: one learner, many rollout workers.
#[derive(Debug, Parser)]
#[command(name = "dmprl", version, after_help = EXAMPLES, after_long_help = long_help())]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Train a policy on a task.
    Train(Box<train::TrainArgs>),
    /// Resume a stopped or crashed run.
    Resume(resume::ResumeArgs),
    /// Evaluate a run's policy without noise.
    Eval(eval::EvalArgs),
    /// Train many runs described in one file; resumes an interrupted sweep.
    Sweep(sweep::SweepArgs),
    /// Compare runs and sweeps: tables, statistics and learning curves on one page.
    Report(report::ReportArgs),
    /// Show runs on a web page, during and after training.
    Dashboard(dashboard::DashboardArgs),
    /// Show and convert demonstrations, also of Minari and LeRobot.
    Demos(demos::DemosArgs),
    /// Make a video of a policy, or of two side by side.
    Record(record::RecordArgs),
    /// Play a policy live, in a window or in a browser.
    Play(play::PlayArgs),
    /// Export a run's policy to one file, for a robot or an ONNX runtime.
    Export(export::ExportArgs),
    /// Upload a run's policy to the Hugging Face hub, with a model card.
    Push(push::PushArgs),
    /// Download a policy from the Hugging Face hub.
    Pull(pull::PullArgs),
    /// Benchmark a part of the system against alternatives.
    Bench(bench::BenchArgs),
    /// Kill a run's processes on a schedule and check that no data is lost.
    Chaos(chaos::ChaosArgs),
    /// Run workers on this host for a run whose learner is on another.
    Bridge(bridge::BridgeArgs),
    /// List the built-in tasks.
    Tasks(tasks::TasksArgs),
    /// Show the Python environment, and add or remove packages.
    Env(env::EnvArgs),
    /// Check this machine and suggest remedies.
    Doctor(doctor::DoctorArgs),
    /// Remove the shared memory of dead runs.
    Clean(clean::CleanArgs),
    /// Print shell completions.
    Completions(completions::CompletionsArgs),
    /// Write the manual pages.
    Man(completions::ManArgs),
    /// Learner process; started by train.
    #[command(hide = true)]
    Learner(LearnerArgs),
    /// Rollout worker process; started by train.
    #[command(hide = true)]
    Actor(ActorArgs),
    /// Evaluator process; started by train and eval.
    #[command(hide = true)]
    Evaluator(EvaluatorArgs),
    /// Process that records every step of a policy's episodes; started by record and report.
    #[command(hide = true)]
    Observer(ObserverArgs),
    /// Process that receives the segments of workers on other hosts; started by train.
    #[command(hide = true)]
    Gateway(GatewayArgs),
    /// Process that forwards segments and policies on a host without a learner; started by bridge.
    #[command(hide = true)]
    Relay(RelayArgs),
    /// Process that only sends segments; started by bench transport.
    #[command(hide = true)]
    TransportWorker(TransportWorkerArgs),
    /// Process with many synthetic workers, which only send segments; started by bench scale.
    #[command(hide = true)]
    SegmentFeeder(SegmentFeederArgs),
}

fn long_help() -> String {
    format!("{ROLES}{EXAMPLES}")
}

/// candle computes the products of graphs on rayon's threads, and asks this variable for their
/// number.
const CANDLE_THREADS: &str = "RAYON_NUM_THREADS";

/// Parses a command line, runs the command and returns its exit status.
///
/// `words` begins with the path of this program, which is started for other roles.
///
/// # Safety
/// No other thread uses environment variables.
#[must_use]
pub unsafe fn main(words: Vec<OsString>) -> u8 {
    // The products of our networks are too small for several threads, and rayon's wait actively.
    if std::env::var_os(CANDLE_THREADS).is_none() {
        // SAFETY: As this function.
        unsafe { std::env::set_var(CANDLE_THREADS, "1") };
    }
    dmprl_run::project::set_git_commit(env!("GIT_COMMIT_OF_BUILD"));
    // Handles help and version; on a usage error, suggests similar names and exits with 2.
    let arguments = Arguments::parse_from(words);
    messages::install(arguments.command.message_style());
    let result = run(arguments.command);
    if let Err(error) = &result {
        messages::show_error(&render(error));
    }
    exit_status(&result)
}

impl Command {
    /// Format of messages on standard error.
    fn message_style(&self) -> MessageStyle {
        let output = match self {
            Self::Train(args) => args.output,
            Self::Resume(args) => args.output,
            Self::Bridge(args) => args.output,
            Self::Learner(_) | Self::Evaluator(_) | Self::Gateway(_) | Self::Relay(_) => {
                return MessageStyle::Log;
            }
            Self::Actor(args) if args.join.is_none() => return MessageStyle::Log,
            _ => return MessageStyle::Text,
        };
        match output.style() {
            ProgressStyle::Events => MessageStyle::Json,
            _ => MessageStyle::Text,
        }
    }
}

/// Resolves the configuration of `dmprl train` with these arguments.
fn train_configuration(arguments: &[String]) -> anyhow::Result<ExperimentConfig> {
    let words = ["dmprl", "train"].into_iter().chain(arguments.iter().map(String::as_str));
    match Arguments::try_parse_from(words) {
        Ok(Arguments { command: Command::Train(args) }) => train::configuration(&args),
        Ok(_) => Err(wrong_use("expected arguments of `dmprl train`")),
        Err(error) => Err(wrong_use(error.to_string())),
    }
}

fn run(command: Command) -> anyhow::Result<Outcome> {
    match command {
        Command::Train(args) => train::run(&args),
        Command::Resume(args) => resume::run(&args),
        Command::Eval(args) => eval::run(&args),
        Command::Sweep(args) => sweep::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Dashboard(args) => dashboard::run(&args),
        Command::Demos(args) => demos::run(&args),
        Command::Record(args) => record::run(&args),
        Command::Play(args) => play::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Push(args) => push::run(&args),
        Command::Pull(args) => pull::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::Chaos(args) => chaos::run(&args),
        Command::Bridge(args) => bridge::run(&args),
        Command::Tasks(args) => tasks::run(&args),
        Command::Env(args) => env::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Clean(args) => clean::run(&args),
        Command::Completions(args) => completions::completions(&args),
        Command::Man(args) => completions::man(&args),
        Command::Learner(args) => roles::learner(&args).map(|()| Outcome::Done),
        Command::Actor(args) => roles::actor(&args),
        Command::Evaluator(args) => roles::evaluator(&args).map(|()| Outcome::Done),
        Command::Observer(args) => roles::observer(&args).map(|()| Outcome::Done),
        Command::Gateway(args) => roles::gateway(&args).map(|()| Outcome::Done),
        Command::Relay(args) => roles::relay(&args).map(|()| Outcome::Done),
        Command::TransportWorker(args) => transport_worker(&args).map(|()| Outcome::Done),
        Command::SegmentFeeder(args) => segment_feeder(&args).map(|()| Outcome::Done),
    }
}

/// Prints a result on standard output. A closed pipe (`| head`) is not an error.
fn emit(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        result => result.context("cannot write to standard output"),
    }
}

/// Installs Python and our package if they are missing, and shows the progress; returns the virtual
/// environment.
#[cfg(feature = "python")]
fn prepare_python() -> anyhow::Result<PathBuf> {
    let progress = TerminalProgress::default();
    Ok(Home::find()?.ensure(&|line| progress.state(line))?.venv)
}

/// Creates the manifest's record of a session that trains `config` in this virtual environment.
#[cfg(feature = "python")]
fn training_session(config: &ExperimentConfig, venv: &Path) -> anyhow::Result<Session> {
    Session::training(config, packages(&python_of(venv))?)
}

#[cfg(not(feature = "python"))]
fn training_session(_config: &ExperimentConfig, _venv: &Path) -> anyhow::Result<Session> {
    Ok(Session::now())
}

/// Like [`prepare_python`], with an extra of the package; also returns the interpreter.
#[cfg(feature = "python")]
fn prepare_python_with(extra: &str) -> anyhow::Result<(PathBuf, PathBuf)> {
    let progress = TerminalProgress::default();
    let ready = ensure_extra(&Home::find()?, extra, &|line| progress.state(line))?;
    Ok((ready.venv, ready.executable))
}

/// Returns the path of the virtual environment, which may not exist yet, and the path from which
/// other interpreters can `import dmprl`.
#[cfg(feature = "python")]
fn python_home() -> anyhow::Result<(PathBuf, PathBuf)> {
    let home = Home::find()?;
    Ok((home.venv(), home.package_path()))
}

#[cfg(not(feature = "python"))]
fn python_home() -> anyhow::Result<(PathBuf, PathBuf)> {
    let root = dmprl_run::project::root()?;
    Ok((root.join(".venv"), root.join("envs_py")))
}

#[cfg(not(feature = "python"))]
fn prepare_python_with(_extra: &str) -> anyhow::Result<(PathBuf, PathBuf)> {
    prepare_python().map(|venv| (venv.clone(), python_of(&venv)))
}

/// Installs the packages of the file `requirements` into an environment of their own, unless it has
/// them, and shows the progress; returns its interpreter.
#[cfg(feature = "python")]
fn separate_python(venv: &Path, requirements: &Path) -> anyhow::Result<PathBuf> {
    let progress = TerminalProgress::default();
    Ok(ensure_separate(venv, requirements, &|line| progress.state(line))?.executable)
}

#[cfg(not(feature = "python"))]
fn separate_python(_venv: &Path, _requirements: &Path) -> anyhow::Result<PathBuf> {
    prepare_python()
}

/// Returns the interpreter of a virtual environment.
#[cfg(feature = "python")]
fn python_of(venv: &Path) -> PathBuf {
    PythonEnvironment::of(venv.to_owned()).executable
}

#[cfg(not(feature = "python"))]
fn python_of(venv: &Path) -> PathBuf {
    venv.join("bin/python")
}

#[cfg(not(feature = "python"))]
fn prepare_python() -> anyhow::Result<PathBuf> {
    anyhow::bail!("this build has no Python support; build it with the feature `python`")
}

/// Opens a run directory, or the copy of a policy `zoo:NAME`.
fn open_run(path: &Path) -> anyhow::Result<RunDirectory> {
    match Zoo::name(path) {
        None => RunDirectory::open(path),
        Some(name) => {
            let package = python_home()?.1.join("dmprl");
            Zoo::of_package(&package).open(name, Path::new("runs"))
        }
    }
}

/// Returns the path of this program, which also plays the roles: all processes are the same build.
fn this_program() -> anyhow::Result<PathBuf> {
    #[cfg(feature = "python")]
    if let Some(host) = dmprl_actors::python_env::host() {
        return Ok(host.program.clone());
    }
    std::env::current_exe().context("cannot find the path of this program")
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Arguments::command().debug_assert();
    }
}
