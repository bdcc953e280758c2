//! `dmprl sweep`: trains many runs from one file.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use dmprl_run::RunDirectory;
use dmprl_run::RunLock;
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::{grouped, shown};
use dmprl_run::sweep_files::{Ledger, Plan, PlannedRun, SweepFile};
use dmprl_shared::config::ExperimentConfig;
use dmprl_supervisor::RESUME_WAIT;
use dmprl_sweep::{RunState, Site, Sweep, states, sweep};

use super::{cores, emit, prepare_python, search, this_program, train_configuration};
use crate::terminal::{TerminalProgress, say};

const HELP: &str = "\
FILE is TOML. Trains every task with every method, at every point of the grid, with every seed.
  seeds = [1, 2, 3]
  set = { evaluation.episodes = 20 }      # any configuration key, for every run
  [[task]]
  name = \"reacher\"
  steps = 60_000
  [[method]]                              # optional; without: the defaults
  name = \"td3-mlp\"                        # part of the runs' paths
  label = \"TD3\"                           # in plots and tables
  algo = \"td3\"
  policy = \"mlp\"                          # also preset; set, as above
  [grid]
  algorithm.batch_size = [128, 256]
Each run is a `dmprl train` in OUTPUT/TASK/METHOD[/VALUES]/seed-S. After a stop or a crash, run the
same command again: it skips finished runs and resumes the others from their checkpoints. A failed
run does not affect the others; the next start retries it.
On Ctrl-C the runs write a checkpoint; a second Ctrl-C stops them at once.

SEARCH, instead of [grid]: Optuna suggests the values of each trial.
  [search]
  trials = 40                             # for each task and method
  objective = \"return\"                    # or success; of the last evaluation, maximised
  sampler = \"tpe\"                         # or random
  pruner = \"median\"                       # or hyperband, none
  prune_after_trials = 5                  # finished trials before the median pruner starts
  seed = 0                                # of the sampler
  [search.space]
  algorithm.critic_learning_rate = { low = 1e-4, high = 3e-3, log = true }
  dmp.basis_count = { low = 3, high = 7 }    # integers, because the key holds an integer
  exploration.kind = [\"gaussian\", \"pink\"]  # one of these
  [[search.first]]                        # tried first; missing values are suggested by Optuna
  dmp.basis_count = 5
A trial is trained with each seed, one after the other, in OUTPUT/TASK/METHOD/trial-N/seed-S; its
objective is the mean over the seeds. The pruner compares each evaluation with the evaluation of the
same number in other trials. A pruned trial is interrupted and not resumed. A failed trial counts as
a trial. Trials are evaluated on episodes with seeds from 5000 on (evaluation.first_seed; lower
values are rejected). By default `train` evaluates on seeds from 1000 on. Train the best
configuration again to measure its performance:
  dmprl train TASK --config OUTPUT/TASK/METHOD/best.toml
The first search installs Optuna into .venv. OUTPUT/optuna.db is its storage, which its own tools
can read too: optuna-dashboard sqlite:///OUTPUT/optuna.db

EXAMPLES
  dmprl sweep mine.toml --dry-run    # list the runs and their progress
  dmprl sweep mine.toml --jobs 4
  dmprl sweep mine.toml --print-commands > runs.txt    # for a job array: docs/slurm.md
  dmprl sweep deploy/experiments/search-reacher.toml";

/// Arguments of `dmprl sweep`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct SweepArgs {
    /// The sweep file.
    pub(super) file: PathBuf,
    /// Output directory of the runs [default: runs/ and the file's name without .toml].
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Concurrent runs, or trials in a search [default: as many as fit the cores, with one per
    /// worker and one for the learner].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(super) jobs: Option<u16>,
    /// Only list the runs, or a search's space and trials, with their progress.
    #[arg(long)]
    pub(super) dry_run: bool,
    /// Only print a shell command for each run that is not finished, one per line, for a batch
    /// system. Afterwards, start the sweep once more: it records the finished runs.
    #[arg(long, conflicts_with_all = ["dry_run", "json", "jobs"])]
    pub(super) print_commands: bool,
    /// Print one JSON object on standard output, with the directory and state of each run or trial.
    #[arg(long)]
    pub(super) json: bool,
}

pub(super) fn run(args: &SweepArgs) -> anyhow::Result<Outcome> {
    let (file, text) = SweepFile::read(&args.file)?;
    let output = args.output.clone().map_or_else(|| default_output(&args.file), Ok)?;
    let site = Site { program: this_program()?, output, text, checkpointed_steps };
    if let Some(search) = &file.search {
        if args.print_commands {
            return Err(wrong_use(
                "a search has no --print-commands: its trials depend on the results of others"
                    .to_owned(),
            ));
        }
        return search::run(args, &file, search, site);
    }
    let runs = configured(Plan::new(&file)?)?;
    let jobs = jobs(args, runs.iter().map(|(_, config)| config));
    let ledger = Ledger::open(&site.output)?;
    let mut plan = Sweep { site, runs, jobs, ledger };
    if args.print_commands {
        return print_commands(plan).map(|()| Outcome::Done);
    }
    if args.dry_run {
        let states = states(&plan)?;
        return report(&plan, &states, args.json).map(|()| Outcome::Done);
    }
    let _lock = take(&mut plan.site)?;
    plan.ledger = Ledger::open(&plan.site.output)?;
    // Prepare Python once, before several runs need it at the same time.
    prepare_python()?;
    finish(plan, args)
}

/// Prints a shell command for each run that is not finished. Their paths are absolute.
fn print_commands(mut plan: Sweep) -> anyhow::Result<()> {
    let output = &mut plan.site.output;
    *output = std::path::absolute(&*output)
        .with_context(|| format!("cannot resolve {}", output.display()))?;
    let states = states(&plan)?;
    let open = plan.runs.iter().zip(&states).filter(|(_, state)| **state != RunState::Finished);
    let commands = open.map(|((run, config), _)| plan.site.shell_command(run, config));
    emit(&commands.collect::<Vec<_>>().join("\n"))
}

/// Environment steps of the newest checkpoint of a run; 0 if there is none.
fn checkpointed_steps(run: &RunDirectory) -> anyhow::Result<u64> {
    let counters = dmprl_learner::checkpoint::counters(&run.checkpoints_path())?;
    Ok(counters.iter().map(|counters| counters.env_steps).max().unwrap_or(0))
}

/// Creates the sweep's directory and locks it.
pub(super) fn take(site: &mut Site) -> anyhow::Result<RunLock> {
    let output = &mut site.output;
    std::fs::create_dir_all(&*output)
        .with_context(|| format!("cannot create {}", output.display()))?;
    *output = std::fs::canonicalize(&*output)
        .with_context(|| format!("cannot resolve {}", output.display()))?;
    // Children inherit the lock: those of a killed sweep first write their checkpoints.
    RunLock::take(output, RESUME_WAIT)
}

fn finish(mut plan: Sweep, args: &SweepArgs) -> anyhow::Result<Outcome> {
    let (count, folder) = (plan.runs.len(), shown(&plan.site.output));
    say(&format!("{count} runs in {folder}, {} at once", plan.jobs));
    let ended = sweep(&mut plan, &TerminalProgress::default())?;
    report(&plan, &ended.states, args.json)?;
    let again = format!("dmprl sweep {}", args.file.display());
    if ended.interrupted {
        say(&format!("resume with: {again}"));
        return Ok(Outcome::Interrupted);
    }
    let failed = |state: &&RunState| matches!(state, RunState::Failed { .. });
    match ended.states.iter().filter(failed).count() {
        0 => Ok(Outcome::Done),
        1 => bail!("a run failed, see above; retry with: {again}"),
        count => bail!("{count} runs failed, see above; retry with: {again}"),
    }
}

/// Returns the configuration of each run; reports the first mistake in the file before any run
/// starts.
fn configured(plan: Plan) -> anyhow::Result<Vec<(PlannedRun, ExperimentConfig)>> {
    let configured = plan.runs.into_iter().map(|run| {
        let config = train_configuration(&run.arguments)
            .map_err(|error| wrong_use(format!("{}: {error:#}", run.title())))?;
        Ok((run, config))
    });
    configured.collect()
}

fn default_output(file: &Path) -> anyhow::Result<PathBuf> {
    let name = file.file_stem().with_context(|| format!("{} has no name", file.display()))?;
    Ok(Path::new("runs").join(name))
}

/// Returns the number of concurrent runs: as given, or as many as have a core for each worker and
/// for the learner. Workers wait most of the time, so the learner's second thread uses their cores.
pub(super) fn jobs<'a>(
    args: &SweepArgs,
    runs: impl Iterator<Item = &'a ExperimentConfig>,
) -> usize {
    let wanted = |config: &ExperimentConfig| config.learner.threads.max(config.actors.workers + 1);
    let most = runs.map(wanted).max().unwrap_or(1);
    args.jobs.map_or_else(|| (cores() / most.max(1)).max(1), usize::from)
}

fn report(plan: &Sweep, states: &[RunState], json: bool) -> anyhow::Result<()> {
    let runs = plan.runs.iter().zip(states);
    if json {
        let listed: Vec<_> = runs
            .map(|((run, config), state)| {
                let (state, env_steps, reason) = match state {
                    RunState::Finished => ("finished", config.run.steps, None),
                    RunState::Open { env_steps } => ("open", *env_steps, None),
                    RunState::Failed { reason } => ("failed", 0, Some(reason)),
                };
                serde_json::json!({
                    "task": run.task, "method": run.method, "point": run.point, "seed": run.seed,
                    "run": plan.site.output.join(&run.directory), "state": state,
                    "env_steps": env_steps, "steps": config.run.steps, "reason": reason,
                })
            })
            .collect();
        return emit(&serde_json::json!({ "runs": listed, "jobs": plan.jobs }).to_string());
    }
    let lines = runs.map(|((run, config), state)| {
        let state = match state {
            RunState::Finished => "finished".to_owned(),
            RunState::Open { env_steps: 0 } => "not started".to_owned(),
            RunState::Open { env_steps } => {
                format!("at {} of {} steps", grouped(*env_steps), grouped(config.run.steps))
            }
            RunState::Failed { .. } => "failed".to_owned(),
        };
        format!("  {:<26} {}", state, run.title())
    });
    emit(&lines.collect::<Vec<_>>().join("\n"))
}
