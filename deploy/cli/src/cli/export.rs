//! `dmprl export`: writes a run's policy as one file.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use dmprl_analysis::export::{onnx, read_policy, safetensors};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::{binary_bytes, shown};
use dmprl_run::{PolicyChoice, replace_file};
use dmprl_shared::config::Execution;
use dmprl_shared::policy::{Hold, Policy};
use dmprl_shared::policy_file::OpenedPolicy;

use super::{emit, open_run};

const HELP: &str = "\
The file contains everything needed to act: observation normalisation, network, movement primitive,
controller, start, action bounds, and its origin. safetensors is read by the crate dmprl-runtime,
without Python, and in Python by dmprl.Policy, which needs only NumPy. onnx is for any ONNX runtime:
input `observation` (batch, O), output `actions` (batch, K, A).

For a robot, state with --hold the command that holds it, as in docs/robot.md. Without it, the file
acts in simulations; on a robot, the program that drives it must state the hold.

A robot executes segments as policy.execution states in training; --execution changes it. Runs from
before this key have `segment`, and `ensemble` makes them smoother. An onnx file
computes whole segments with both.

EXAMPLES
  dmprl export runs/mine                           # runs/mine/reacher.safetensors
  dmprl export runs/mine --hold zero-velocity      # for a robot that takes velocities
  dmprl export runs/mine --hold position=0.1,-0.5  # for a robot that takes positions of two joints
  dmprl export runs/old --execution ensemble
  dmprl export runs/mine --format onnx --output reacher.onnx
  dmprl export runs/mine --policy latest --json";

/// Arguments of `dmprl export`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct ExportArgs {
    /// The run directory, or zoo:TASK for a policy that comes with dmprl.
    run: PathBuf,
    /// File format [default: by the extension of --output, else safetensors].
    #[arg(long)]
    format: Option<Format>,
    /// Output file; an existing one is replaced [default: the task's name, in the run directory].
    #[arg(long, value_name = "PATH")]
    output: Option<PathBuf>,
    /// best (by success rate, then by return), latest, or a policy version.
    #[arg(long, default_value_t = PolicyChoice::Best, value_name = "best|latest|VERSION")]
    policy: PolicyChoice,
    /// Command that holds the robot: zero-velocity, zero-torque, or position=V,V,… with one value
    /// per action.
    #[arg(long, value_name = "HOLD", allow_hyphen_values = true)]
    hold: Option<Hold>,
    /// How a robot executes segments, instead of the run's policy.execution.
    #[arg(long, value_name = "segment|ensemble")]
    execution: Option<Execution>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    Safetensors,
    Onnx,
}

impl Format {
    fn extension(self) -> &'static str {
        match self {
            Self::Safetensors => "safetensors",
            Self::Onnx => "onnx",
        }
    }

    fn of(output: &Path) -> Option<Self> {
        let end = output.extension()?.to_str()?;
        [Self::Safetensors, Self::Onnx].into_iter().find(|format| format.extension() == end)
    }
}

/// Rejects an existing output that is not a regular file: root could replace even a device.
pub(super) fn check_output(path: &Path) -> anyhow::Result<()> {
    let refused = |what: &str| Err(wrong_use(format!("--output {}: {what}", path.display())));
    if path.exists() && !path.is_file() {
        return refused("expected a file or a new name, got something that is not a regular file");
    }
    match path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        Some(folder) if !folder.is_dir() => refused("the folder does not exist; create it first"),
        _ => Ok(()),
    }
}

/// Adds the hold of `--hold` to a policy.
pub(super) fn state_hold(opened: &mut OpenedPolicy, hold: Option<&Hold>) -> anyhow::Result<()> {
    let Some(hold) = hold else { return Ok(()) };
    hold.action(&opened.policy.description().spec)
        .map_err(|error| wrong_use(format!("--hold {hold}: {error}")))?;
    opened.hold = Some(hold.clone());
    Ok(())
}

/// Changes how a robot executes segments.
fn state_execution(opened: &mut OpenedPolicy, execution: Execution) -> anyhow::Result<()> {
    let mut description = opened.policy.description().clone();
    description.policy.execution = execution;
    opened.policy = Policy::new(description)?;
    Ok(())
}

pub(super) fn run(args: &ExportArgs) -> anyhow::Result<Outcome> {
    let named = args.output.as_deref().and_then(Format::of);
    let format = args.format.or(named).unwrap_or(Format::Safetensors);
    if let (Some(named), Some(output)) = (named, &args.output)
        && named != format
    {
        return Err(wrong_use(format!(
            "--output {} has the extension of the other format; expected .{}, or omit --format",
            output.display(),
            format.extension()
        )));
    }
    let run = open_run(&args.run)?;
    let chosen = run.choose_policy(args.policy)?;
    let mut opened = read_policy(&run, &chosen)?;
    state_hold(&mut opened, args.hold.as_ref())?;
    args.execution.map_or(Ok(()), |execution| state_execution(&mut opened, execution))?;
    let task = run.config()?.task.name;
    let path = args.output.clone().unwrap_or_else(|| {
        let name = dmprl_run::safe_name(&task);
        run.path().join(format!("{name}.{}", format.extension()))
    });
    check_output(&path)?;
    let file = match format {
        Format::Safetensors => safetensors(&opened)?,
        Format::Onnx => onnx(&opened)?,
    };
    replace_file(&path, &file)?;
    let bytes = file.len() as u64;
    let (layout, row) = (opened.policy.layout(), chosen.row.as_ref());
    emit(&if args.json {
        serde_json::json!({
            "path": path, "format": format.extension(), "bytes": bytes,
            "task": task, "policy_version": chosen.version,
            "return_mean": row.map(|row| row.return_mean),
            "success_rate": row.and_then(|row| row.success_rate),
            "observation_len": opened.policy.env_observation_len(),
            "segment_steps": layout.segment_steps, "action_len": layout.action_len,
            "hold": opened.hold.as_ref().map(Hold::to_string),
        })
        .to_string()
    } else {
        let did = row.map(|row| format!(", return {:.2}", row.return_mean)).unwrap_or_default();
        let head = format!(
            "{} ({}): policy {} of {task}{did}",
            shown(&path),
            binary_bytes(bytes),
            chosen.version
        );
        let held = opened.hold.as_ref().map_or_else(
            || "no hold stated; for a robot, export with --hold".to_owned(),
            |hold| format!("held by {hold}"),
        );
        match format {
            Format::Safetensors => format!(
                "{head}\n{held}\nin Python: dmprl.Policy.load({:?}).action(observation)",
                path.display().to_string()
            ),
            Format::Onnx => format!("{head}\n{held}"),
        }
    })?;
    Ok(Outcome::Done)
}
