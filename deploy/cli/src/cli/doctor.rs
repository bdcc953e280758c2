//! `dmprl doctor`: checks this machine and suggests remedies.

use anyhow::bail;
use clap::Args;
use dmprl_run::failure::Outcome;
use dmprl_shared::config::{ExperimentConfig, Limits, TASKS, TaskDefaults};

use super::configuration::{Sources, merge, refuse};
use super::{cores, emit};
use crate::doctor::{DefaultRun, Report};

const HELP: &str = "\
Changes nothing: it neither installs nor creates anything. A warning is for information; a problem
prevents runs from working. Exit status 1 if there is a problem.

EXAMPLES
  dmprl doctor
  dmprl doctor --json";

/// Arguments of `dmprl doctor`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct DoctorArgs {
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &DoctorArgs) -> anyhow::Result<Outcome> {
    let runs = TASKS
        .iter()
        .map(|task| Ok(DefaultRun { task, config: default_config(task)? }))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let report = Report::of_this_machine(&runs);
    emit(&if args.json { report.json().to_string() } else { report.text() })?;
    match report.problems() {
        0 => Ok(Outcome::Done),
        1 => bail!("1 problem; its remedy is listed above"),
        count => bail!("{count} problems; their remedies are listed above"),
    }
}

/// The configuration of `dmprl train TASK` without flags on this machine.
fn default_config(task: &TaskDefaults) -> anyhow::Result<ExperimentConfig> {
    let sources = Sources {
        task: task.name,
        preset: "default",
        file: None,
        environment: Vec::new(),
        set: &[],
        env_kwargs: &[],
        flags: Vec::new(),
    };
    merge(&sources)?.resolve(Limits { cores: cores() }).map_err(refuse)
}
