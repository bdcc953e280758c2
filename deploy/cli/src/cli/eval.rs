//! `dmprl eval`: evaluates a run's policy with the evaluator process that `train` uses.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use dmprl_control::{EvaluationRequest, EvaluationRow};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::{plus_minus, std_of};
use dmprl_run::{ChosenPolicy, PolicyChoice, RunDirectory};
use dmprl_shared::config::{Execution, ExperimentConfig, Layers, Limits, RandomiseConfig};
use dmprl_supervisor::{self as launch, EvaluationPlan};
use toml::Table;

use super::configuration::refuse;
use super::trust::TrustArgs;
use super::{emit, open_run, prepare_python, this_program};

/// Mean returns that differ by at most this much count as equal.
const SAME_RETURN: f64 = 1e-6;

/// Prefix of keys that an evaluation may set.
const RANDOMISE: &str = "task.randomise.";
/// Another key that it may set.
const EXECUTION: &str = "policy.execution";

const HELP: &str = "\
Uses the evaluation episodes and seeds of training, so it reproduces the stored figures. Writes only
a log into the run directory. The first use of zoo:TASK copies it to runs/zoo-TASK.

--set tests the policy with other ranges of task.randomise than it was trained with, or with another
policy.execution.

EXAMPLES
  dmprl eval runs/mine
  dmprl eval zoo:panda-pick-and-place
  dmprl eval runs/mine --policy latest --episodes 100
  dmprl eval runs/mine --policy 4120 --json
  dmprl eval runs/mine --set policy.execution=segment
  dmprl eval runs/mine --set 'task.randomise.mass=[0.5, 2.0]' --episodes 100";

/// Arguments of `dmprl eval`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct EvalArgs {
    /// The run directory, or zoo:TASK for a policy that comes with dmprl.
    run: PathBuf,
    /// best (by success rate, then by return), latest, or a policy version.
    #[arg(long, default_value_t = PolicyChoice::Best, value_name = "best|latest|VERSION")]
    policy: PolicyChoice,
    /// Number of episodes [default: as in the policy's evaluation during training].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    episodes: Option<u64>,
    /// Set policy.execution or a key of task.randomise for these episodes; repeatable.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    trust: TrustArgs,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &EvalArgs) -> anyhow::Result<Outcome> {
    let run = open_run(&args.run)?;
    let chosen = run.choose_policy(args.policy)?;
    let config = run.config()?;
    args.trust.check_for(&run, &config)?;
    let stored = chosen.row.as_ref().map_or(config.evaluation.episodes, |row| row.returns.len());
    let changed = changed(config, &args.set)?;
    let randomise = changed.as_ref().map(|changed| toml::to_string(&changed.randomise));
    let venv = prepare_python()?;
    let plan = EvaluationPlan {
        program: this_program()?,
        run: &run,
        venv: Some(venv),
        request: request(&chosen),
        episodes: args.episodes.unwrap_or(stored as u64),
        randomise: randomise.transpose().context("task.randomise")?,
        execution: changed.as_ref().map(|changed| changed.execution),
    };
    let Some(row) = launch::evaluate(plan)? else { return Ok(Outcome::Interrupted) };
    let result = Evaluated { row, chosen, changed };
    emit(&if args.json { result.json(&run) } else { result.text() })?;
    Ok(Outcome::Done)
}

/// Settings that `--set` may change; everything else stays as in training.
struct Changed {
    randomise: RandomiseConfig,
    execution: Execution,
}

/// Applies the pairs of `--set` to the run's configuration; `None` without any.
fn changed(config: ExperimentConfig, pairs: &[String]) -> anyhow::Result<Option<Changed>> {
    if pairs.is_empty() {
        return Ok(None);
    }
    let mut layers = Layers::new();
    layers.add("config.toml", Table::try_from(config)?)?;
    for pair in pairs {
        let allowed = |key: &str| key.starts_with(RANDOMISE) || key.trim() == EXECUTION;
        let named = pair.split_once('=').filter(|(key, _)| allowed(key));
        let (key, text) = named.ok_or_else(|| {
            wrong_use(format!(
                "--set {pair}: expected {RANDOMISE}KEY=[LOW, HIGH] or {EXECUTION}=NAME"
            ))
        })?;
        layers.set("--set", key.trim(), text.trim()).map_err(refuse)?;
    }
    let config = layers.finish().and_then(|config| config.resolve(Limits { cores: 1 }));
    let config = config.map_err(refuse)?;
    let (randomise, execution) = (config.task.randomise, config.policy.execution);
    Ok(Some(Changed { randomise, execution }))
}

/// An evaluation, for display.
struct Evaluated {
    row: EvaluationRow,
    chosen: ChosenPolicy,
    /// Settings other than the run's.
    changed: Option<Changed>,
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

impl Evaluated {
    fn json(&self, run: &RunDirectory) -> String {
        let Self { row, chosen, changed } = self;
        let mut object = serde_json::json!(row);
        if chosen.row.is_none() {
            // The policy was not evaluated in training: these are the request's placeholder zeros.
            for name in ["env_steps", "updates", "segments", "wall_s"] {
                object[name] = serde_json::Value::Null;
            }
        }
        if let Some(changed) = changed {
            object["randomise"] = serde_json::json!(changed.randomise);
            object["execution"] = changed.execution.name().into();
        }
        object["run"] = run.path().display().to_string().into();
        object["return_std"] = std_of(&row.returns).into();
        object["episodes"] = row.returns.len().into();
        object.to_string()
    }

    fn text(&self) -> String {
        let Self { row, chosen, changed } = self;
        let mut lines = vec![format!(
            "return      {} over {} episodes",
            plus_minus(&row.returns),
            row.returns.len()
        )];
        if let Some(rate) = row.success_rate {
            lines.push(format!("success     {:.0} %", rate * 100.0));
        }
        lines
            .push(format!("smoothness  {:.4}  (mean |change of action| per step)", row.smoothness));
        lines.push(format!("policy      {}", chosen.version));
        if let Some(stored) = &chosen.row
            && stored.returns.len() == row.returns.len()
        {
            let difference = (stored.return_mean - row.return_mean).abs();
            let verdict = match changed {
                Some(_) => "without --set",
                None if difference <= SAME_RETURN => "the same",
                None => "DIFFERENT",
            };
            lines.push(format!("in training {:.6} ({verdict})", stored.return_mean));
        }
        lines.join("\n")
    }
}
