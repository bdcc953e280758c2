//! The evaluator process: noise-free episodes of saved policies.

use std::time::Duration;

use dmprl_actors::evaluate::{ENVIRONMENTS_MAX, Evaluator};
use dmprl_actors::python_env::{Interpreter, PythonEnvironments};
use dmprl_learner::checkpoint;
use dmprl_learner::policy_file::{self, Match};
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::spec::EnvSpec;

use super::setup::Setup;
use super::{ControlPipe, EvaluatorArgs};
use crate::control::{Command, EvaluationRequest, EvaluationRow, Report};

/// How long one look for a command may block, so that a stop is seen.
const COMMAND_WAIT: Duration = Duration::from_millis(100);

/// Answers requests until a stop is asked for.
pub fn run(args: &EvaluatorArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let setup = Setup::read(&args.run)?;
    let mut config = setup.config.clone();
    if let Some(episodes) = args.episodes {
        config.evaluation.episodes = usize::try_from(episodes)?;
    }
    let interpreter = super::actor::interpreter(args.venv.as_deref(), &config)?;
    let (mut evaluator, spec) = evaluator(&interpreter, &config)?;
    control.send(&Report::EnvironmentReady { spec })?;
    while !control.stop_requested() {
        let Some(Command::Evaluate(request)) = control.next_within(COMMAND_WAIT) else { continue };
        let row = evaluate(&mut evaluator, &setup, &config, &request)?;
        if !args.print_only {
            keep(&setup, &row)?;
        }
        control.send(&Report::Evaluated(row))?;
    }
    Ok(())
}

/// Environments and policy of an evaluation.
pub fn evaluator(
    interpreter: &Interpreter,
    config: &ExperimentConfig,
) -> anyhow::Result<(Evaluator, EnvSpec)> {
    let envs = config.evaluation.episodes.min(ENVIRONMENTS_MAX);
    let steps = config.policy.decision_steps();
    let environments = PythonEnvironments::start(interpreter, &config.task.id, envs, steps)?;
    let spec = environments.spec().clone();
    Ok((Evaluator::new(config, environments, envs)?, spec))
}

/// Evaluates a saved policy.
pub fn evaluate(
    evaluator: &mut Evaluator,
    setup: &Setup,
    config: &ExperimentConfig,
    request: &EvaluationRequest,
) -> anyhow::Result<EvaluationRow> {
    let path = setup.run.policy_path(request.policy_version);
    let snapshot = policy_file::load(&path, evaluator.policy(), Match::Architecture)?;
    let settings = &config.evaluation;
    let evaluation =
        evaluator.evaluate(&snapshot.values, settings.episodes, settings.first_seed)?;
    let EvaluationRequest { env_steps, updates, segments, wall_s, policy_version } = *request;
    Ok(EvaluationRow {
        env_steps,
        updates,
        segments,
        wall_s,
        policy_version,
        return_mean: evaluation.return_mean(),
        returns: evaluation.returns,
        success_rate: evaluation.success_rate,
        smoothness: evaluation.smoothness,
    })
}

/// Appends the row and drops the policies that no row needs any more.
pub fn keep(setup: &Setup, row: &EvaluationRow) -> anyhow::Result<()> {
    setup.run.append_evaluation(row)?;
    // A resume goes back to a checkpoint and forgets later rows: the policies that would then be
    // best and latest must still be there.
    let rows = setup.run.evaluations()?;
    let mut versions = Vec::new();
    for env_steps in checkpoint::env_steps(&setup.run.checkpoints_path())? {
        let seen = || rows.iter().filter(|row| row.env_steps <= env_steps);
        let best = seen().max_by(|a, b| a.return_mean.total_cmp(&b.return_mean));
        versions.extend(best.into_iter().chain(seen().next_back()).map(|row| row.policy_version));
    }
    setup.run.point_best()?;
    setup.run.prune_policies(&versions)
}
