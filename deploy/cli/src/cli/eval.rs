//! `dmprl eval`: evaluates a run's policy with the evaluator process that `train` uses.

use std::path::PathBuf;

use clap::Args;
use dmprl_control::{EvaluationRequest, EvaluationRow};
use dmprl_run::failure::Outcome;
use dmprl_run::format::{plus_minus, std_of};
use dmprl_run::{ChosenPolicy, PolicyChoice, RunDirectory};
use dmprl_supervisor::{self as launch, EvaluationPlan};

use super::trust::TrustArgs;
use super::{emit, prepare_python, this_program};

/// Mean returns that differ by at most this much count as equal.
const SAME_RETURN: f64 = 1e-6;

const HELP: &str = "\
Uses the evaluation episodes and seeds of training, so it reproduces the stored figures. Writes only
a log into the run directory.

EXAMPLES
  dmprl eval runs/mine
  dmprl eval runs/mine --policy latest --episodes 100
  dmprl eval runs/mine --policy 4120 --json";

/// Arguments of `dmprl eval`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct EvalArgs {
    /// The run directory.
    run: PathBuf,
    /// best, latest, or a policy version.
    #[arg(long, default_value_t = PolicyChoice::Best, value_name = "best|latest|VERSION")]
    policy: PolicyChoice,
    /// Number of episodes [default: as in the policy's evaluation during training].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    episodes: Option<u64>,
    #[command(flatten)]
    trust: TrustArgs,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &EvalArgs) -> anyhow::Result<Outcome> {
    let run = RunDirectory::open(&args.run)?;
    let chosen = run.choose_policy(args.policy)?;
    let config = run.config()?;
    args.trust.check_for(&run, &config)?;
    let stored = chosen.row.as_ref().map_or(config.evaluation.episodes, |row| row.returns.len());
    let venv = prepare_python()?;
    let plan = EvaluationPlan {
        program: this_program()?,
        run: &run,
        venv: Some(venv),
        request: request(&chosen),
        episodes: args.episodes.unwrap_or(stored as u64),
    };
    let Some(row) = launch::evaluate(plan)? else { return Ok(Outcome::Interrupted) };
    emit(&if args.json { json(&run, &row, &chosen) } else { text(&row, &chosen) })?;
    Ok(Outcome::Done)
}

fn request(chosen: &ChosenPolicy) -> EvaluationRequest {
    let zero = EvaluationRequest {
        env_steps: 0,
        updates: 0,
        segments: 0,
        wall_s: 0.0,
        policy_version: chosen.version,
    };
    chosen.row.as_ref().map_or(zero, |row| EvaluationRequest {
        env_steps: row.env_steps,
        updates: row.updates,
        segments: row.segments,
        wall_s: row.wall_s,
        policy_version: row.policy_version,
    })
}

fn json(run: &RunDirectory, row: &EvaluationRow, chosen: &ChosenPolicy) -> String {
    let mut object = serde_json::json!(row);
    if chosen.row.is_none() {
        // The policy was not evaluated in training: these are the request's placeholder zeros.
        for name in ["env_steps", "updates", "segments", "wall_s"] {
            object[name] = serde_json::Value::Null;
        }
    }
    object["run"] = run.path().display().to_string().into();
    object["return_std"] = std_of(&row.returns).into();
    object["episodes"] = row.returns.len().into();
    object.to_string()
}

fn text(row: &EvaluationRow, chosen: &ChosenPolicy) -> String {
    let mut lines = vec![format!(
        "return      {} over {} episodes",
        plus_minus(&row.returns),
        row.returns.len()
    )];
    if let Some(rate) = row.success_rate {
        lines.push(format!("success     {:.0} %", rate * 100.0));
    }
    lines.push(format!("smoothness  {:.4}  (mean |change of action| per step)", row.smoothness));
    lines.push(format!("policy      {}", chosen.version));
    if let Some(stored) = &chosen.row
        && stored.returns.len() == row.returns.len()
    {
        let difference = (stored.return_mean - row.return_mean).abs();
        let verdict = if difference <= SAME_RETURN { "the same" } else { "DIFFERENT" };
        lines.push(format!("in training {:.6} ({verdict})", stored.return_mean));
    }
    lines.join("\n")
}
