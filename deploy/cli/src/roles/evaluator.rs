//! The evaluator's process: prepares environments for the loop in `dmprl_actors::evaluator` and
//! writes the rows of `evaluations.jsonl`.

use anyhow::Context;
use dmprl_actors::evaluator::{self, Evaluations};
use dmprl_control::{EvaluationRow, Report};
use dmprl_learner::checkpoint;
use dmprl_run::Setup;
use dmprl_shared::supervision::Supervisor;
use tracing::warn;

use super::environments::on_hang;
use super::{ControlPipe, EvaluatorArgs};

/// Answers requests until a stop is requested.
pub fn run(args: &EvaluatorArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let setup = Setup::read(&args.run)?;
    let mut config = setup.config.clone();
    if let Some(episodes) = args.episodes {
        config.evaluation.episodes = usize::try_from(episodes)?;
        config.evaluation.final_episodes = 0;
    }
    if let Some(text) = &args.randomise {
        config.task.randomise = toml::from_str(text).context("--randomise")?;
    }
    if let Some(execution) = args.execution {
        config.policy.execution = execution;
    }
    let interpreter = super::actor::start_interpreter(args.venv.as_deref(), &config)?;
    let mut evaluator = evaluator::evaluator(&interpreter, &config, on_hang(control))?;
    let policy_path = |version| setup.run.policy_path(version);
    let stop = control.stop_flag();
    let evaluations = Evaluations { config: &config, policy_path: &policy_path, stop };
    let mut kept = |row: &EvaluationRow| match args.print_only {
        true => Ok(()),
        false => keep(&setup, row, control).map_err(Into::into),
    };
    Ok(evaluator::run(&mut evaluator, &evaluations, control, &mut kept)?)
}

/// Appends the row and removes policies that no row needs any longer. If writing fails, it sends a
/// warning: a full disk must not end a run.
///
/// # Errors
/// A number of the row is not finite.
pub fn keep(setup: &Setup, row: &EvaluationRow, control: &ControlPipe) -> anyhow::Result<()> {
    row.check_finite()?;
    let steps =
        [("append to evaluations.jsonl", append(setup, row)), ("remove old policies", tidy(setup))];
    for (step, result) in steps {
        if let Err(error) = result {
            let version = row.policy_version;
            let message = format!("evaluation of policy {version}: cannot {step}: {error:#}");
            warn!("{message}");
            // If the supervisor is gone, the loop notices it as a stop.
            let _ = control.send(&Report::Warning { message });
        }
    }
    Ok(())
}

/// Appends the row unless the last row is of the same policy: an evaluator that was killed between
/// row and report gets the same request again.
fn append(setup: &Setup, row: &EvaluationRow) -> anyhow::Result<()> {
    let latest = setup.run.latest_row()?;
    if latest.is_some_and(|latest| latest.policy_version == row.policy_version) {
        return Ok(());
    }
    setup.run.append_evaluation(row)
}

/// Removes policies that are no longer needed. A resume from a checkpoint drops later rows, so the
/// policies that would then be best and latest are kept for each checkpoint.
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
    use dmprl_shared::config::ExperimentConfig;

    use super::*;
    use dmprl_run::{Manifest, RunDirectory};

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
        at_bounds: None,
    };

    fn setup(parent: &tempfile::TempDir) -> Setup {
        let (path, manifest) = (parent.path().join("run"), Manifest::new(None).unwrap());
        RunDirectory::create(&path, &ExperimentConfig::default(), &manifest).unwrap();
        Setup::read(&path).unwrap()
    }

    fn control() -> ControlPipe {
        ControlPipe::over(std::io::empty(), std::io::sink(), || {})
    }

    /// An evaluator killed between row and report answers the same request again.
    #[test]
    fn a_policy_evaluated_twice_has_one_row() {
        let parent = tempfile::tempdir().unwrap();
        let setup = setup(&parent);
        keep(&setup, &ROW, &control()).unwrap();
        keep(&setup, &ROW, &control()).unwrap();
        assert_eq!(setup.run.evaluations().unwrap(), [ROW]);
    }

    #[test]
    fn a_row_that_cannot_be_written_is_tolerated_and_one_that_is_not_finite_is_an_error() {
        let parent = tempfile::tempdir().unwrap();
        let setup = setup(&parent);
        let path = setup.run.evaluations_path();
        std::fs::remove_file(&path).unwrap();
        std::fs::create_dir(&path).unwrap();
        keep(&setup, &ROW, &control()).unwrap();
        keep(&setup, &EvaluationRow { smoothness: f64::NAN, ..ROW }, &control()).unwrap_err();
    }
}
