//! `dmprl push`: uploads a policy to the Hugging Face hub.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use dmprl_analysis::export::read_policy;
use dmprl_analysis::publication;
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::shown;
use dmprl_run::{PolicyChoice, RunDirectory};
use dmprl_shared::policy::Hold;

use super::export::state_hold;
use super::hub::{Repository, transfer};
use super::{emit, open_run};

/// Extensions of films that the hub shows.
const FILM_EXTENSIONS: [&str; 2] = ["mp4", "gif"];

const HELP: &str = "\
Creates the repository if it does not exist. Uploads, in one commit, policy.safetensors as `dmprl
export` writes it, the run's configuration and evaluations, and a model card with task, result,
seeds and the commands that use the policy; with a video of the policy that `dmprl record` made in
the run directory. Folders are removed from the configuration, and absolute paths shortened in the
command line; arguments of the environment (task.kwargs) are uploaded as they are.

The token with write access is that of HF_TOKEN or of a login, whose command is shown if neither
exists. HF_ENDPOINT selects another hub than huggingface.co.

EXAMPLES
  dmprl push runs/mine me/panda-push
  dmprl push runs/mine me/panda-push --private --policy latest
  dmprl push runs/mine me/panda-push --film best.mp4 --message 'Train for 400,000 steps'
  dmprl push runs/mine me/my-arm --hold zero-velocity      # for a robot that takes velocities";

/// Arguments of `dmprl push`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct PushArgs {
    /// The run directory, or zoo:TASK for a policy that comes with dmprl.
    run: PathBuf,
    /// The repository.
    #[arg(value_name = "OWNER/NAME")]
    repository: Repository,
    /// best (by success rate, then by return), latest, or a policy version.
    #[arg(long, default_value_t = PolicyChoice::Best, value_name = "best|latest|VERSION")]
    policy: PolicyChoice,
    /// Command that holds the robot, as in `dmprl export`.
    #[arg(long, value_name = "HOLD", allow_hyphen_values = true)]
    hold: Option<Hold>,
    /// Create a private repository. An existing public one is rejected.
    #[arg(long)]
    private: bool,
    /// Film for the model card, an MP4 or GIF [default: a video of the policy in the run].
    #[arg(long, value_name = "FILE")]
    film: Option<PathBuf>,
    /// Message of the commit.
    #[arg(long, value_name = "TEXT")]
    message: Option<String>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &PushArgs) -> anyhow::Result<Outcome> {
    let run = open_run(&args.run)?;
    let chosen = run.choose_policy(args.policy)?;
    let Some(row) = &chosen.row else {
        return Err(wrong_use(format!(
            "policy {} was not evaluated in training, so the model card would have no result; \
             choose best, latest or an evaluated version",
            chosen.version
        )));
    };
    let film = match &args.film {
        Some(film) => Some(checked_film(film)?),
        None => recorded_film(&run, chosen.version)?,
    };
    let mut opened = read_policy(&run, &chosen)?;
    state_hold(&mut opened, args.hold.as_ref())?;
    let task = run.config()?.task.name;

    let temporary = tempfile::tempdir().context("cannot create a folder for the upload")?;
    let folder = temporary.path().join("repository");
    publication::write(&run, &chosen, &opened, &folder)?;
    let default = format!("Upload policy {} of {task}", chosen.version);
    let message = args.message.as_deref().filter(|text| !text.is_empty()).unwrap_or(&default);
    let mut words: Vec<OsString> =
        vec!["push".into(), folder.into(), args.repository.to_string().into()];
    words.push(format!("--policy-version={}", chosen.version).into());
    words.push(format!("--message={message}").into());
    if args.private {
        words.push("--private".into());
    }
    if let Some(film) = &film {
        let mut word = OsString::from("--film=");
        word.push(film);
        words.push(word);
    }
    let Some(done) = transfer(&words, &temporary.path().join("answer.json"))? else {
        return Ok(Outcome::Interrupted);
    };
    emit(&if args.json {
        serde_json::json!({
            "repository": args.repository.to_string(), "url": done.address, "commit": done.commit,
            "task": task, "policy_version": chosen.version, "return_mean": row.return_mean,
            "success_rate": row.success_rate, "film": film,
        })
        .to_string()
    } else {
        let (address, commit) = (&done.address, done.short_commit());
        let (version, mean) = (chosen.version, row.return_mean);
        let film = film.map_or_else(
            || format!("none; make one with dmprl record {}", args.run.display()),
            |film| shown(&film),
        );
        [
            format!("{address}: policy {version} of {task}, return {mean:.2}, commit {commit}"),
            format!("film: {film}"),
            format!("download it: dmprl pull {}", args.repository),
        ]
        .join("\n")
    })?;
    Ok(Outcome::Done)
}

fn checked_film(film: &Path) -> anyhow::Result<PathBuf> {
    let extension = film.extension().and_then(|extension| extension.to_str()).unwrap_or_default();
    let is_film = FILM_EXTENSIONS.contains(&extension.to_ascii_lowercase().as_str());
    if !is_film || !film.is_file() {
        let got = if is_film { "no such file" } else { "another extension" };
        return Err(wrong_use(format!(
            "--film {}: expected an existing .mp4 or .gif, got {got}",
            film.display()
        )));
    }
    Ok(film.to_owned())
}

/// Finds a video of a policy that `dmprl record` made in the run, without comparisons. Of several
/// it is the last by name: one of several episodes, if there is one.
fn recorded_film(run: &RunDirectory, version: u64) -> anyhow::Result<Option<PathBuf>> {
    let folder = run.path().join("videos");
    if !folder.is_dir() {
        return Ok(None);
    }
    let unread = || format!("cannot read {}", folder.display());
    let mut last = None;
    for entry in folder.read_dir().with_context(unread)? {
        let path = entry.with_context(unread)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name.starts_with(&format!("policy-{version}-seed")) && name.ends_with(".mp4") {
            last = last.max(Some(path));
        }
    }
    Ok(last)
}
