//! `dmprl pull`: downloads a policy from the Hugging Face hub.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use dmprl_analysis::publication::{POLICY_FILE, as_run};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::shown;
use dmprl_run::{ChosenPolicy, RunDirectory, replace_file};

use super::configured::absolute_folder;
use super::emit;
use super::export::check_output;
use super::hub::{Repository, Transfer, transfer};

const HELP: &str = "\
Downloads a policy that `dmprl push` uploaded, and makes a run directory of it, which `play`,
`eval`, `record`, `export` and `train --init-from` take. It has no checkpoint, so `resume` cannot
continue it. With an output NAME.safetensors it writes only the policy file, for
`dmprl.Policy.load`.

Public repositories need no token; for private ones see `dmprl push --help`. Downloading imports no
code. If the configuration names modules or arguments of the environment, the first command that
creates it lists them and asks for --trust-code.

EXAMPLES
  dmprl pull me/panda-push                          # runs/me-panda-push
  dmprl play runs/me-panda-push
  dmprl pull me/panda-push --revision 4f1c2a9e0b    # a branch, a tag or a commit
  dmprl pull me/panda-push --output push.safetensors
  dmprl pull me/my-arm --python-path my-tasks";

/// Arguments of `dmprl pull`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct PullArgs {
    /// The repository.
    #[arg(value_name = "OWNER/NAME")]
    repository: Repository,
    /// Branch, tag or commit [default: the newest].
    #[arg(long, value_name = "REVISION")]
    revision: Option<String>,
    /// Run directory to create, or a policy file NAME.safetensors, which is replaced if it exists
    /// [default: runs/OWNER-NAME].
    #[arg(long, value_name = "PATH")]
    output: Option<PathBuf>,
    /// Directory of the task's modules, if the task does not come with dmprl; repeatable.
    #[arg(long, value_name = "DIR")]
    python_path: Vec<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &PullArgs) -> anyhow::Result<Outcome> {
    let default = || Path::new("runs").join(args.repository.run_name());
    let output = args.output.clone().unwrap_or_else(default);
    let is_file = output.extension().is_some_and(|end| end == "safetensors");
    if is_file {
        check_output(&output)?;
        if !args.python_path.is_empty() {
            return Err(wrong_use(format!(
                "--python-path is for a run directory, and {} is a policy file, which has no place \
                 for it; leave one of them out",
                output.display()
            )));
        }
    }
    let folders = args.python_path.iter().map(|folder| absolute_folder(&folder.to_string_lossy()));
    let python_path = folders.collect::<anyhow::Result<Vec<_>>>()?;

    let temporary = tempfile::tempdir().context("cannot create a folder for the download")?;
    let folder = temporary.path().join("repository");
    let mut words: Vec<OsString> =
        vec!["pull".into(), folder.clone().into(), args.repository.to_string().into()];
    if let Some(revision) = &args.revision {
        words.push(format!("--revision={revision}").into());
    }
    let Some(done) = transfer(&words, &temporary.path().join("answer.json"))? else {
        return Ok(Outcome::Interrupted);
    };
    let unusable = || format!("{} is not a policy that this dmprl can use", done.address);
    let bytes = std::fs::read(folder.join(POLICY_FILE)).with_context(unusable)?;
    let (downloaded, chosen) = as_run(&folder).with_context(unusable)?;
    if is_file {
        replace_file(&output, &bytes)?;
    } else {
        let origin = format!("hub:{}@{}", args.repository, done.commit);
        place(&downloaded, &origin, &output, python_path)?;
    }
    let pulled = Pulled { output, is_file, done, chosen, task: downloaded.config()?.task.name };
    emit(&if args.json { pulled.json(&args.repository) } else { pulled.text() })?;
    Ok(Outcome::Done)
}

/// Copies the policy to its run directory, unless it is there already.
fn place(
    downloaded: &RunDirectory,
    origin: &str,
    output: &Path,
    python_path: Vec<String>,
) -> anyhow::Result<()> {
    if !output.exists() {
        downloaded
            .copy_policy(origin, output)
            .with_context(|| format!("cannot write {}", output.display()))?;
    }
    let there = RunDirectory::open(output).ok().and_then(|run| run.copied_from());
    if there.as_deref() != Some(origin) {
        let found = there.map_or_else(
            || "is no copy of a policy".to_owned(),
            |other| format!("is a copy of {other}"),
        );
        return Err(wrong_use(format!(
            "{} exists and {found}; expected {origin} or a new name; rename or remove it, or \
             choose another --output",
            output.display()
        )));
    }
    if !python_path.is_empty() {
        let run = RunDirectory::open(output)?;
        let mut config = run.config()?;
        config.task.python_path = python_path;
        run.write_config(&config)?;
    }
    Ok(())
}

/// A downloaded policy, for display.
struct Pulled {
    output: PathBuf,
    /// Whether the output is a policy file, not a run directory.
    is_file: bool,
    done: Transfer,
    chosen: ChosenPolicy,
    task: String,
}

impl Pulled {
    fn json(&self, repository: &Repository) -> String {
        let row = self.chosen.row.as_ref();
        serde_json::json!({
            "path": self.output, "repository": repository.to_string(), "url": self.done.address,
            "commit": self.done.commit, "task": self.task, "policy_version": self.chosen.version,
            "return_mean": row.map(|row| row.return_mean),
            "success_rate": row.and_then(|row| row.success_rate),
        })
        .to_string()
    }

    fn text(&self) -> String {
        let row = self.chosen.row.as_ref();
        let result = row.map(|row| format!(", return {:.2}", row.return_mean)).unwrap_or_default();
        let path = self.output.display().to_string();
        let next = if self.is_file {
            format!("in Python: dmprl.Policy.load({path:?})")
        } else {
            format!("show it: dmprl play {path}")
        };
        format!(
            "{}: policy {} of {}{result}, commit {}\n{next}",
            shown(&self.output),
            self.chosen.version,
            self.task,
            self.done.short_commit()
        )
    }
}
