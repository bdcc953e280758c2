//! `dmprl play`: shows a policy live.

use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context, bail};
use clap::Args;
use dmprl_analysis::export::{read_policy, safetensors};
use dmprl_run::PolicyChoice;
use dmprl_run::failure::Outcome;

use super::attended::attend;
use super::trust::TrustArgs;
use super::{open_run, prepare_python_with};
use crate::terminal::say;

/// Extra of the Python package for rendering.
const EXTRA: &str = "video";

const HELP: &str = "\
Plays noise-free episodes in real time, each with its own seed, until Ctrl-C. It opens a window if
there is a display; otherwise it serves a page on loopback and prints its address. From another
machine: ssh -L 8788:127.0.0.1:8788 HOST, then http://127.0.0.1:8788/.

EXAMPLES
  dmprl play zoo:panda-pick-and-place
  dmprl play runs/mine
  dmprl play runs/mine --policy latest --seed 1004 --episodes 3
  dmprl play runs/mine --stream --port 8788";

/// Arguments of `dmprl play`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct PlayArgs {
    /// The run directory, or zoo:TASK for a policy that comes with dmprl.
    run: PathBuf,
    /// best (by success rate, then by return), latest, or a policy version.
    #[arg(long, default_value_t = PolicyChoice::Best, value_name = "best|latest|VERSION")]
    policy: PolicyChoice,
    /// Seed of the first episode [default: evaluation.first_seed of the run].
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Stop after this many episodes [default: never].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    episodes: Option<u64>,
    /// Serve a page even if there is a display.
    #[arg(long)]
    stream: bool,
    /// Port of the page; 0: any free port.
    #[arg(long, value_name = "PORT", default_value_t = 8788)]
    port: u16,
    #[command(flatten)]
    trust: TrustArgs,
}

pub(super) fn run(args: &PlayArgs) -> anyhow::Result<Outcome> {
    let run = open_run(&args.run)?;
    let config = run.config()?;
    args.trust.check_for(&run, &config)?;
    let opened = read_policy(&run, &run.choose_policy(args.policy)?)?;
    let (_, python) = prepare_python_with(EXTRA)?;
    let folder = tempfile::tempdir().context("cannot create a folder for the policy")?;
    let file = folder.path().join("policy.safetensors");
    std::fs::write(&file, safetensors(&opened)?).context("cannot write the policy")?;
    let window = !args.stream && has_display();
    let mut command = Command::new(python);
    command.args(["-I", "-m", "dmprl.play"]).arg(&file);
    command.args(["--task", &config.task.id, "--options", &config.task.options_toml()]);
    let title = format!("{} · policy {}", config.task.name, opened.snapshot.version);
    command.args(["--title", &title, "--port", &args.port.to_string()]);
    let seed = args.seed.unwrap_or(config.evaluation.first_seed);
    command.args(["--seed", &seed.to_string()]);
    command.args(["--episodes", &args.episodes.unwrap_or(0).to_string()]);
    config.task.python_path.iter().for_each(|path| {
        command.arg("--python-path").arg(path);
    });
    if window {
        command.arg("--window");
    } else {
        say("open this page in a browser (Ctrl-C to stop):");
    }
    match attend(command)? {
        None => Ok(Outcome::Interrupted),
        Some(status) if status.success() => Ok(Outcome::Done),
        Some(status) => bail!("the player ended with {status}; its output is above"),
    }
}

/// Detects X11 or Wayland.
fn has_display() -> bool {
    ["DISPLAY", "WAYLAND_DISPLAY"]
        .into_iter()
        .any(|name| std::env::var_os(name).is_some_and(|value| !value.is_empty()))
}
