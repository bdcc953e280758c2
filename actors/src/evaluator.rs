//! Stage 8 of 8, the evaluator's loop: evaluates the policies that the supervisor requests.
//!
//! The evaluator's process answers one request at a time ([`run`]). The one-process run calls
//! [`evaluate`] when an evaluation is due.

use std::error::Error;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::PolicyError;
use dmprl_shared::policy_file::{self, Match, PolicyFileError};
use dmprl_shared::supervision::{
    Command, EvaluationRequest, EvaluationRow, Report, ReportError, Supervisor,
};
use thiserror::Error;

use crate::environments::{self, EnvironmentsError};
use crate::evaluate::{ENVIRONMENTS_MAX, Episodes, Evaluator};
use crate::policy_health::PolicyHealth;
use crate::python_env::Interpreter;
use crate::rollout::RolloutError;

/// Maximum wait for a command; a stop request is checked in between.
const COMMAND_WAIT: Duration = Duration::from_millis(100);

/// Why evaluations ended.
#[derive(Debug, Error)]
pub enum EvaluationError {
    /// The environments cannot be created.
    #[error(transparent)]
    Environments(#[from] EnvironmentsError),
    /// The policy does not fit the environments.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// The saved policy cannot be used.
    #[error(transparent)]
    PolicyFile(#[from] PolicyFileError),
    /// The environments failed.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// The supervisor is gone.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// The caller rejected a row.
    #[error(transparent)]
    Row(Box<dyn Error + Send + Sync>),
}

/// Creates the environments and the policy for a run's evaluations. `on_hang` is called if a call
/// into the environments does not return (see [`environments::watch`]).
///
/// # Errors
/// If the environments cannot be created, or the policy does not fit them.
pub fn evaluator(
    interpreter: &Interpreter,
    config: &ExperimentConfig,
    on_hang: impl FnOnce(String) + Send + 'static,
) -> Result<Evaluator, EvaluationError> {
    let envs = config.evaluation.episodes.min(ENVIRONMENTS_MAX);
    let steps = config.policy.execution_steps();
    let environments = environments::make(interpreter, config, envs, steps, on_hang)?;
    Ok(Evaluator::new(config, environments, envs)?)
}

/// Settings for all evaluations of a run.
pub struct Evaluations<'a> {
    /// The run's configuration.
    pub config: &'a ExperimentConfig,
    /// Returns the path of a saved policy, by version.
    pub policy_path: &'a dyn Fn(u64) -> PathBuf,
    /// Aborts the current evaluation.
    pub stop: &'a AtomicBool,
}

/// Outcome of an evaluation.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// The evaluation is complete.
    Row(EvaluationRow),
    /// An episode failed twice; the next evaluation may succeed.
    Failed(String),
    /// A stop was requested.
    Stopped,
}

/// Stores a row; an error ends the evaluator.
pub type Keep<'a> = &'a mut dyn FnMut(&EvaluationRow) -> Result<(), Box<dyn Error + Send + Sync>>;

/// Answers evaluation requests until a stop is requested. Each row is passed to `keep` before it is
/// reported.
///
/// # Errors
/// If the environments fail, a policy cannot be loaded, `keep` fails or the supervisor is gone. A
/// new process may succeed.
pub fn run(
    evaluator: &mut Evaluator,
    evaluations: &Evaluations<'_>,
    supervisor: &dyn Supervisor,
    keep: Keep<'_>,
) -> Result<(), EvaluationError> {
    let spec = evaluator.environments().spec().clone();
    supervisor.report(&Report::EnvironmentReady { spec })?;
    let mut health = PolicyHealth::default();
    while !supervisor.stop_requested() {
        let command = supervisor.next_command(COMMAND_WAIT);
        let Some(Command::Evaluate(request)) = command else { continue };
        let answer = evaluate(evaluator, evaluations, &request);
        environments::report_failures(&evaluator.take_failures(), supervisor);
        match answer? {
            Answer::Row(row) => {
                keep(&row).map_err(EvaluationError::Row)?;
                for message in health.check(&row) {
                    supervisor.report(&Report::Warning { message })?;
                }
                supervisor.report(&Report::Evaluated(row))?;
            }
            Answer::Failed(reason) => {
                let policy_version = request.policy_version;
                supervisor.report(&Report::NotEvaluated { policy_version, reason })?;
            }
            Answer::Stopped => break,
        }
    }
    Ok(())
}

/// Evaluates a saved policy.
///
/// # Errors
/// If the policy cannot be loaded, or the environments fail permanently.
pub fn evaluate(
    evaluator: &mut Evaluator,
    evaluations: &Evaluations<'_>,
    request: &EvaluationRequest,
) -> Result<Answer, EvaluationError> {
    let path = (evaluations.policy_path)(request.policy_version);
    let snapshot = policy_file::load(&path, evaluator.policy(), Match::Architecture)?;
    let settings = &evaluations.config.evaluation;
    let count = settings.episodes_at(request.env_steps, evaluations.config.run.steps);
    let first_seed = settings.first_seed;
    let episodes = Episodes { count, first_seed, stop: evaluations.stop };
    let evaluation = match evaluator.evaluate(&snapshot.values, episodes) {
        Ok(Some(evaluation)) => evaluation,
        Ok(None) => return Ok(Answer::Stopped),
        Err(error @ RolloutError::Episode { .. }) => return Ok(Answer::Failed(error.to_string())),
        Err(error) => return Err(error.into()),
    };
    let EvaluationRequest { env_steps, updates, segments, wall_s, policy_version } = *request;
    Ok(Answer::Row(EvaluationRow {
        env_steps,
        updates,
        segments,
        wall_s,
        policy_version,
        return_mean: evaluation.return_mean(),
        returns: evaluation.returns,
        success_rate: evaluation.success_rate,
        smoothness: evaluation.smoothness,
        at_bounds: Some(evaluation.at_bounds),
    }))
}
