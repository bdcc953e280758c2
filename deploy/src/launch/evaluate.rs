//! One evaluation outside training, for `dmprl eval`: an evaluator, one request, one answer.

use std::path::PathBuf;

use anyhow::bail;

use super::conversation::{Conversation, Turn};
use super::{Launcher, TimeLimits};
use crate::control::{Command, EvaluationRequest, EvaluationRow, Report};
use crate::run_directory::RunDirectory;

/// What to evaluate.
pub struct EvaluationPlan<'a> {
    /// The program that plays the evaluator: this one; tests put a fake here.
    pub program: PathBuf,
    /// The run.
    pub run: &'a RunDirectory,
    /// The Python virtual environment.
    pub venv: Option<PathBuf>,
    /// The policy, and where it stood in training.
    pub request: EvaluationRequest,
    /// How many episodes.
    pub episodes: u64,
}

/// Evaluates one saved policy; none when the user interrupted it.
///
/// # Errors
/// The evaluator died or took too long.
pub fn evaluate(plan: EvaluationPlan<'_>) -> anyhow::Result<Option<EvaluationRow>> {
    let launcher = Launcher::outside_training(plan.program, plan.run, plan.venv);
    let command = launcher.evaluate(plan.episodes)?;
    let episodes = usize::try_from(plan.episodes).unwrap_or(usize::MAX);
    let answer_limit = TimeLimits::default().evaluation_of(episodes);
    let evaluator = Conversation { who: "the evaluator", log: plan.run.log_path("eval") };
    evaluator.hold(command, |report| {
        Ok(match report {
            Report::EnvironmentReady { .. } => {
                Turn::Ask(Command::Evaluate(plan.request.clone()), "done", answer_limit)
            }
            Report::Evaluated(row) => Turn::Over(row),
            Report::NotEvaluated { reason, .. } => {
                bail!("the evaluation failed: {reason}{}", evaluator.log_tail())
            }
            _ => Turn::GoOn,
        })
    })
}
