//! The command line: what may be typed, its help, and who answers.

mod bench;
mod bench_learner;
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
mod doctor;
mod eval;
mod export;
mod output;
mod play;
mod record;
mod report;
mod resume;
mod search;
mod session;
mod sweep;
mod tasks;
mod train;

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::{Parser, Subcommand};
use dmprl_bench::{SegmentFeederArgs, TransportWorkerArgs, segment_feeder, transport_worker};
use dmprl_run::Progress;
use dmprl_run::Session;
use dmprl_run::failure::{Outcome, exit_code, render, wrong_use};
use dmprl_shared::config::ExperimentConfig;

use crate::roles::{
    self, ActorArgs, EvaluatorArgs, GatewayArgs, LearnerArgs, ObserverArgs, RelayArgs,
};
use crate::terminal::messages::{self, MessageStyle};
use crate::terminal::{ProgressStyle, TerminalProgress};
#[cfg(feature = "python")]
use dmprl_supervisor::python_setup::{Home, ensure_extra};
pub use session::{TrainingPlan, train_session};

const EXAMPLES: &str = "\
EXAMPLES
  dmprl train reacher                      train with the defaults; nothing else is needed
  dmprl eval runs/reacher-td3-dmp-s1-…    how well does its best policy do?
  dmprl resume runs/reacher-td3-dmp-s1-…  go on where it stopped
  dmprl actor --join runs/reacher-td3-…   one more worker for a run that is being trained
  dmprl bridge --connect tcp/10.0.0.1:7447 --token-file bridge.token   workers on another host
  dmprl record runs/reacher-td3-dmp-s1-…  what does it look like?
  dmprl dashboard                          watch every run in a browser
  dmprl tasks                              what can be trained
  dmprl doctor                             what this machine has and lacks

`dmprl COMMAND --help` has the details. Exit status: 0 done, 1 failed, 2 wrong use,
130 interrupted.";

const ROLES: &str = "\
ROLES (train starts them; each has --help)
  learner    replays, updates, publishes policies, writes checkpoints
  actor      steps environments and sends segments
  evaluator  evaluates saved policies without noise
  observer   writes down, step by step, what a saved policy does
  gateway    stands for the workers of other hosts
  relay      stands for the learner on a host that has none (bridge starts it)

";

/// Learns robot manipulation with DMP policies: one learner, many rollout workers.
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
    /// Go on with a run that was stopped or has died.
    Resume(resume::ResumeArgs),
    /// Evaluate a run's policy without noise.
    Eval(eval::EvalArgs),
    /// Train many runs from one file, side by side, and go on where it was stopped.
    Sweep(sweep::SweepArgs),
    /// Set runs and sweeps side by side: tables, statistics, learning curves, one page.
    Report(report::ReportArgs),
    /// Show runs on a web page, while they are trained and afterwards.
    Dashboard(dashboard::DashboardArgs),
    /// Make a video of a policy, or of two side by side.
    Record(record::RecordArgs),
    /// Watch a policy at work, in a window or in a browser.
    Play(play::PlayArgs),
    /// Write a run's policy as one file, for a robot or an ONNX runtime.
    Export(export::ExportArgs),
    /// Measure a part of the system beside what else could do its work.
    Bench(bench::BenchArgs),
    /// Kill a run's processes by a schedule and check that nothing is lost.
    Chaos(chaos::ChaosArgs),
    /// Step environments on this host for a run whose learner is on another.
    Bridge(bridge::BridgeArgs),
    /// List the tasks with a short name.
    Tasks(tasks::TasksArgs),
    /// Check what this machine has for runs, and say what to do.
    Doctor(doctor::DoctorArgs),
    /// Remove what dead runs have left in shared memory.
    Clean(clean::CleanArgs),
    /// Print what a shell needs to complete commands and flags.
    Completions(completions::CompletionsArgs),
    /// Write the manual pages.
    Man(completions::ManArgs),
    /// A run's learner process; started by train.
    #[command(hide = true)]
    Learner(LearnerArgs),
    /// A rollout worker process; started by train.
    #[command(hide = true)]
    Actor(ActorArgs),
    /// The process that evaluates; started by train and eval.
    #[command(hide = true)]
    Evaluator(EvaluatorArgs),
    /// The process that writes down what a policy does; started by record.
    #[command(hide = true)]
    Observer(ObserverArgs),
    /// What stands for the workers of other hosts; started by train.
    #[command(hide = true)]
    Gateway(GatewayArgs),
    /// What stands for the learner on a host that has none; started by bridge.
    #[command(hide = true)]
    Relay(RelayArgs),
    /// A process that only sends segments; started by bench transport.
    #[command(hide = true)]
    TransportWorker(TransportWorkerArgs),
    /// A process that plays many workers, which only send segments; started by bench scale.
    #[command(hide = true)]
    SegmentFeeder(SegmentFeederArgs),
}

fn long_help() -> String {
    format!("{ROLES}{EXAMPLES}")
}

/// Parses the command line, does what it says, and tells how it ended.
#[must_use]
pub fn main() -> ExitCode {
    dmprl_run::project::set_git_commit(env!("GIT_COMMIT_OF_BUILD"));
    // Prints help and version, refuses wrong use with the nearest names and exits with 2.
    let arguments = Arguments::parse();
    messages::install(arguments.command.message_style());
    let result = run(arguments.command);
    if let Err(error) = &result {
        messages::show_error(&render(error));
    }
    exit_code(&result)
}

impl Command {
    /// How messages appear on standard error.
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

/// What `dmprl train` with these arguments would train.
fn train_configuration(arguments: &[String]) -> anyhow::Result<ExperimentConfig> {
    let words = ["dmprl", "train"].into_iter().chain(arguments.iter().map(String::as_str));
    match Arguments::try_parse_from(words) {
        Ok(Arguments { command: Command::Train(args) }) => train::configuration(&args),
        Ok(_) => Err(wrong_use("another command than train")),
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
        Command::Record(args) => record::run(&args),
        Command::Play(args) => play::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::Chaos(args) => chaos::run(&args),
        Command::Bridge(args) => bridge::run(&args),
        Command::Tasks(args) => tasks::run(&args),
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

/// Prints a result. A reader that has seen enough (`| head`) is no failure.
fn emit(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        result => result.context("cannot write to standard output"),
    }
}

/// Makes sure that Python and our package are there, telling the user what takes time; returns
/// the virtual environment.
#[cfg(feature = "python")]
fn prepare_python() -> anyhow::Result<PathBuf> {
    let progress = TerminalProgress::default();
    Ok(Home::find()?.ensure(&|line| progress.state(line))?.venv)
}

/// A session that trains `config` in this virtual environment.
#[cfg(feature = "python")]
fn training_session(config: &ExperimentConfig, venv: &Path) -> anyhow::Result<Session> {
    Session::training(config, dmprl_supervisor::python_setup::packages(&venv.join("bin/python"))?)
}

#[cfg(not(feature = "python"))]
fn training_session(_config: &ExperimentConfig, _venv: &Path) -> anyhow::Result<Session> {
    Ok(Session::now())
}

/// The same with an optional part of the package; returns the interpreter, too.
#[cfg(feature = "python")]
fn prepare_python_with(extra: &str) -> anyhow::Result<(PathBuf, PathBuf)> {
    let progress = TerminalProgress::default();
    let ready = ensure_extra(&Home::find()?, extra, &|line| progress.state(line))?;
    Ok((ready.venv, ready.executable))
}

/// The virtual environment, made or not, and what other interpreters need to `import dmprl`.
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
    prepare_python().map(|venv| (venv.clone(), venv.join("bin/python")))
}

#[cfg(not(feature = "python"))]
fn prepare_python() -> anyhow::Result<PathBuf> {
    anyhow::bail!("this build is a learner without Python; build it with the feature `python`")
}

/// Which program plays the roles: every peer is the same build.
fn this_program() -> anyhow::Result<PathBuf> {
    std::env::current_exe().context("cannot find this program's own file")
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
