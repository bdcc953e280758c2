//! Evaluates a policy outside training, for `dmprl eval`.

use std::path::PathBuf;
use std::process::Command;

use anyhow::bail;
use dmprl_control::{self as control, EvaluationRequest, EvaluationRow, Report};
use dmprl_run::RunDirectory;
use dmprl_shared::config::Execution;

use super::conversation::{Conversation, Turn};
use super::launcher::Launcher;
use super::limits::TimeLimits;

/// An evaluation to run.
pub struct EvaluationPlan<'a> {
    /// The program that plays the evaluator: this one, or a fake in tests.
    pub program: PathBuf,
    /// The run.
    pub run: &'a RunDirectory,
    /// The Python virtual environment.
    pub venv: Option<PathBuf>,
    /// The policy and its counts in training.
    pub request: EvaluationRequest,
    /// Number of episodes.
    pub episodes: u64,
    /// Another `task.randomise` than the run's, as TOML.
    pub randomise: Option<String>,
    /// Another `policy.execution` than the run's.
    pub execution: Option<Execution>,
}

/// Evaluates a saved policy; returns `None` if the user interrupts.
///
/// # Errors
/// The evaluator died, failed or took too long.
pub fn evaluate(plan: EvaluationPlan<'_>) -> anyhow::Result<Option<EvaluationRow>> {
    let mut command = Command::new(&plan.program);
    command.args(["evaluator", "--print-only", "--episodes", &plan.episodes.to_string()]);
    command.arg("--run").arg(plan.run.path());
    if let Some(randomise) = &plan.randomise {
        command.arg("--randomise").arg(randomise);
    }
    if let Some(execution) = plan.execution {
        command.arg("--execution").arg(execution.name());
    }
    if let Some(venv) = &plan.venv {
        command.arg("--venv").arg(venv);
    }
    let launcher = Launcher::outside_training(plan.program, plan.run, plan.venv);
    let command = launcher.streams(command, "eval")?;
    let episodes = usize::try_from(plan.episodes).unwrap_or(usize::MAX);
    let limit = TimeLimits::default().evaluation_of(episodes);
    let evaluator = Conversation { who: "the evaluator", log: plan.run.log_path("eval") };
    evaluator.hold(command, |report| {
        Ok(match report {
            Report::EnvironmentReady { .. } => {
                Turn::Ask(control::Command::Evaluate(plan.request.clone()), limit)
            }
            Report::Evaluated(row) => Turn::Done(row),
            Report::NotEvaluated { reason, .. } => {
                bail!("the evaluation failed: {reason}{}", evaluator.log_tail())
            }
            _ => Turn::Continue,
        })
    })
}
