//! The evaluator process: noise-free episodes of saved policies.

use std::sync::atomic::AtomicBool;
use std::time::Duration;

use dmprl_actors::evaluate::{ENVIRONMENTS_MAX, Episodes, Evaluator};
use dmprl_actors::python_env::Interpreter;
use dmprl_actors::rollout::RolloutError;
use dmprl_learner::checkpoint;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy_file::{self, Match};
use dmprl_shared::spec::EnvSpec;

use super::setup::Setup;
use super::{ControlPipe, EvaluatorArgs, environments};
use crate::control::{Command, EvaluationRequest, EvaluationRow, Report};
use crate::terminal::say;

/// How long one look for a command may block, so that a stop is seen.
const COMMAND_WAIT: Duration = Duration::from_millis(100);

/// Answers requests until a stop is asked for.
pub fn run(args: &EvaluatorArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let setup = Setup::read(&args.run)?;
    let mut config = setup.config.clone();
    if let Some(episodes) = args.episodes {
        config.evaluation.episodes = usize::try_from(episodes)?;
        config.evaluation.final_episodes = 0;
    }
    let interpreter = super::actor::interpreter(args.venv.as_deref(), &config)?;
    let (mut evaluator, spec) = evaluator(&interpreter, &config, control)?;
    control.send(&Report::EnvironmentReady { spec })?;
    let stop = control.stop_flag();
    while !control.stop_requested() {
        let Some(Command::Evaluate(request)) = control.next_within(COMMAND_WAIT) else { continue };
        let plan = Plan { setup: &setup, config: &config, stop: &stop };
        let answer = evaluate(&mut evaluator, &plan, &request);
        environments::tell(&evaluator.take_failures(), control);
        match answer? {
            Answer::Row(row) => {
                if !args.print_only {
                    keep(&setup, &row, control)?;
                }
                control.send(&Report::Evaluated(row))?;
            }
            Answer::Failed(reason) => {
                let policy_version = request.policy_version;
                control.send(&Report::NotEvaluated { policy_version, reason })?;
            }
            Answer::Stopped => break,
        }
    }
    Ok(())
}

/// Environments and policy of an evaluation.
pub fn evaluator(
    interpreter: &Interpreter,
    config: &ExperimentConfig,
    control: &ControlPipe,
) -> anyhow::Result<(Evaluator, EnvSpec)> {
    let envs = config.evaluation.episodes.min(ENVIRONMENTS_MAX);
    let made = environments::make(interpreter, config, envs, control)?;
    let spec = made.spec().clone();
    Ok((Evaluator::new(config, made, envs)?, spec))
}

/// What is the same for all evaluations of a run.
pub struct Plan<'a> {
    pub setup: &'a Setup,
    pub config: &'a ExperimentConfig,
    /// Asks to give up the evaluation.
    pub stop: &'a AtomicBool,
}

/// What became of an evaluation.
pub enum Answer {
    Row(EvaluationRow),
    /// An episode failed, and failed again: no reason why the next evaluation should.
    Failed(String),
    /// A stop was asked for.
    Stopped,
}

/// Evaluates a saved policy.
pub fn evaluate(
    evaluator: &mut Evaluator,
    plan: &Plan<'_>,
    request: &EvaluationRequest,
) -> anyhow::Result<Answer> {
    let path = plan.setup.run.policy_path(request.policy_version);
    let snapshot = policy_file::load(&path, evaluator.policy(), Match::Architecture)?;
    let settings = &plan.config.evaluation;
    let count = settings.episodes_at(request.env_steps, plan.config.run.steps);
    let episodes = Episodes { count, first_seed: settings.first_seed, stop: plan.stop };
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
    }))
}

/// Appends the row and drops the policies that no row needs any more.
///
/// A full disk must not end a run: what cannot be written is told, the row still reported.
///
/// # Errors
/// A number of the row is not finite.
pub fn keep(setup: &Setup, row: &EvaluationRow, control: &ControlPipe) -> anyhow::Result<()> {
    row.check_finite()?;
    let steps =
        [("is not in evaluations.jsonl", append(setup, row)), ("did not tidy up", tidy(setup))];
    for (what, result) in steps {
        if let Err(error) = result {
            let message = format!("evaluation of policy {} {what}: {error:#}", row.policy_version);
            say(&format!("warning: {message}"));
            // A supervisor that is gone is noticed by the loop.
            let _ = control.send(&Report::Warning { message });
        }
    }
    Ok(())
}

/// An evaluator that was killed between row and report is asked again: one row is enough.
fn append(setup: &Setup, row: &EvaluationRow) -> anyhow::Result<()> {
    let latest = setup.run.latest_row()?;
    if latest.is_some_and(|latest| latest.policy_version == row.policy_version) {
        return Ok(());
    }
    setup.run.append_evaluation(row)
}

/// A resume goes back to a checkpoint and forgets later rows: the policies that would then be
/// best and latest must still be there.
fn tidy(setup: &Setup) -> anyhow::Result<()> {
    let rows = setup.run.evaluations()?;
    let mut versions = Vec::new();
    for counters in checkpoint::counters(&setup.run.checkpoints_path())? {
        let seen = || rows.iter().filter(|row| row.env_steps <= counters.env_steps);
        let best = seen().max_by(|a, b| a.return_mean.total_cmp(&b.return_mean));
        versions.extend(best.into_iter().chain(seen().next_back()).map(|row| row.policy_version));
    }
    setup.run.point_best()?;
    setup.run.prune_policies(&versions)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_directory::{Manifest, RunDirectory};

    const ROW: EvaluationRow = EvaluationRow {
        env_steps: 10,
        updates: 1,
        segments: 1,
        wall_s: 1.0,
        policy_version: 3,
        returns: Vec::new(),
        return_mean: -1.0,
        success_rate: None,
        smoothness: 0.0,
    };

    fn setup(parent: &tempfile::TempDir) -> Setup {
        let (path, manifest) = (parent.path().join("run"), Manifest::new(None).unwrap());
        RunDirectory::create(&path, &ExperimentConfig::default(), &manifest).unwrap();
        Setup::read(&path).unwrap()
    }

    fn control() -> ControlPipe {
        ControlPipe::over(std::io::empty(), std::io::sink(), || {})
    }

    /// An evaluator killed between its row and its report answers the same request once more.
    #[test]
    fn a_policy_evaluated_twice_in_a_row_has_one_row() {
        let parent = tempfile::tempdir().unwrap();
        let setup = setup(&parent);
        keep(&setup, &ROW, &control()).unwrap();
        keep(&setup, &ROW, &control()).unwrap();
        assert_eq!(setup.run.evaluations().unwrap(), [ROW]);
    }

    #[test]
    fn a_row_that_cannot_be_written_is_no_failure_and_one_that_is_not_finite_is() {
        let parent = tempfile::tempdir().unwrap();
        let setup = setup(&parent);
        let path = setup.run.evaluations_path();
        std::fs::remove_file(&path).unwrap();
        std::fs::create_dir(&path).unwrap();
        keep(&setup, &ROW, &control()).unwrap();
        keep(&setup, &EvaluationRow { smoothness: f64::NAN, ..ROW }, &control()).unwrap_err();
    }
}
