//! `dmprl resume`: resumes a run from its last checkpoint.

use std::path::PathBuf;

use clap::Args;
use dmprl_learner::checkpoint;
use dmprl_run::RunDirectory;
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_shared::config::Limits;
use dmprl_supervisor::capacity;
use dmprl_supervisor::{self as launch, Trial};

use super::configuration::refuse;
use super::configured::check_build;
use super::output::OutputArgs;
use super::trust::TrustArgs;
use super::{
    TrainingPlan, cores, name_limits, prepare_python, this_program, train_session, training_session,
};

const HELP: &str = "\
Resumes from the last checkpoint with the run's own config.toml; environment variables and presets
are ignored. A run without a checkpoint starts from the beginning.

EXAMPLES
  dmprl resume runs/reacher-td3-dmp-s1-20260131-120000
  dmprl resume runs/mine --steps 120000    # extend the run";

/// Arguments of `dmprl resume`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct ResumeArgs {
    /// The run directory.
    run: PathBuf,
    /// New total length of the run [environment steps].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(1..))]
    steps: Option<i64>,
    #[command(flatten)]
    trust: TrustArgs,
    #[command(flatten)]
    pub(super) output: OutputArgs,
}

pub(super) fn run(args: &ResumeArgs) -> anyhow::Result<Outcome> {
    let run = RunDirectory::open(&args.run)?;
    if let Some(origin) = run.copied_from() {
        let path = run.path().display();
        return Err(wrong_use(format!(
            "{path} is a copy of {origin} and has no checkpoint; start a new run from it: dmprl \
             train TASK --init-from {path}"
        )));
    }
    let written = run.config()?;
    let mut config = written.clone().resolve(Limits { cores: cores() }).map_err(refuse)?;
    let steps_before = config.run.steps;
    if let Some(steps) = args.steps {
        config.run.steps = steps.unsigned_abs();
    }
    let folder = run.checkpoints_path();
    let counters = checkpoint::counters(&folder)?;
    let reached = counters.iter().map(|counters| counters.env_steps).max().unwrap_or(0);
    // A run can exceed its length by part of a segment, so its own length must be accepted.
    if config.run.steps < reached.min(steps_before) {
        return Err(wrong_use(format!(
            "--steps {}: the run already has {reached} steps; --steps is the total length of the \
             run",
            config.run.steps
        )));
    }
    for path in &config.task.python_path {
        if !std::path::Path::new(path).is_dir() {
            return Err(wrong_use(format!(
                "the directory {path} of the run's environments does not exist any more; restore \
                 it or change task.python_path in {}",
                run.path().join("config.toml").display()
            )));
        }
    }
    check_build(&config)?;
    args.trust.check_for(&run, &config)?;
    capacity::check(&config, run.spec()?.as_ref())?;
    let venv = prepare_python()?;
    // Before the lock is taken: this starts an interpreter, which would inherit the lock.
    let session = training_session(&config, &venv)?;
    name_limits(&run);
    let lock = run.lock(launch::RESUME_WAIT)?;
    let mut manifest = run.manifest()?;
    manifest.sessions.push(session);
    run.write_manifest(&manifest)?;
    // The configuration of an older version lacks keys that were added later and whose defaults
    // depend on the machine.
    if config != written {
        run.write_config(&config)?;
    }
    train_session(TrainingPlan {
        trial: Trial::default(),
        program: this_program()?,
        run,
        lock,
        config,
        venv: Some(venv),
        resume: true,
        progress: args.output.style(),
    })
}
