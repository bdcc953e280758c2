//! `dmprl demos`: shows and converts demonstrations of other formats. `dmprl.demos` in Python reads
//! them.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use anyhow::{Context, anyhow};
use clap::{Args, Subcommand};
use dmprl_run::failure::{Outcome, WrongUse, wrong_use};
use dmprl_shared::config::{ExperimentConfig, PRESETS};
use tempfile::TempDir;

use super::configuration::{Sources, merge};
use super::configured::{environment, flag, make_absolute, paths, project_folder};
use super::{emit, prepare_python, prepare_python_with, python_of};
use crate::terminal::say;

/// Prefix of the name of a data set in Minari's local store.
pub(super) const MINARI: &str = "minari:";
/// Extra of the Python package that reads the formats of others.
const EXTRA: &str = "demos";
/// Exit status of `dmprl.demos` if a source cannot be used; the reason is on standard error.
const REFUSED: i32 = 2;

const HELP: &str = "\
SOURCE is one of:
  minari:ID   a Minari data set in its local store, such as minari:D4RL/pen/human-v2
  a folder    of a Minari data set, or of a LeRobotDataset of version 2.0, 2.1 or 3.0
  a file      of demonstrations, .npz

EXAMPLES
  dmprl demos show minari:D4RL/pen/human-v2
  dmprl demos show recordings/pick --task panda-pick-and-place
  dmprl demos convert recordings/pick demos.npz --task my_module:MyArm-v0 \\
      --observation observation.state,observation.environment_state --reward next.reward";

/// Arguments of `dmprl demos`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct DemosArgs {
    #[command(subcommand)]
    action: Action,
    /// Print one JSON object on standard output.
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Show episodes, columns, rate, ranges and returns, and the unmet needs of a task.
    Show(ShowArgs),
    /// Write the file that `train --demos` reads.
    Convert(ConvertArgs),
}

#[derive(Debug, Args)]
struct ShowArgs {
    /// The data set.
    source: String,
    #[command(flatten)]
    chosen: ChosenArgs,
}

#[derive(Debug, Args)]
struct ConvertArgs {
    /// The data set.
    source: String,
    /// The file, NAME.npz; an existing one is replaced.
    output: PathBuf,
    #[command(flatten)]
    chosen: ChosenArgs,
}

/// Arguments that choose parts of a data set.
#[derive(Debug, Args)]
struct ChosenArgs {
    /// The task that will be trained, for the order of the observation, lengths, bounds and rate.
    #[arg(long)]
    task: Option<String>,
    /// Directory of your own environment modules; repeatable.
    #[arg(long, value_name = "DIR", requires = "task")]
    python_path: Vec<PathBuf>,
    /// Argument of the environment or of gymnasium.make; repeatable.
    #[arg(long, value_name = "KEY=VALUE", requires = "task")]
    env_kwargs: Vec<String>,
    /// Columns of the observation [default: all entries of Minari, observation.state of LeRobot].
    #[arg(long, value_name = "COLUMN[,COLUMN]")]
    observation: Option<String>,
    /// Column of the action [default: action].
    #[arg(long, value_name = "COLUMN")]
    action: Option<String>,
    /// Column of the rewards, or one number for all steps [default: the data set's rewards, else
    /// those that the task computes from its goals].
    #[arg(long, value_name = "COLUMN|NUMBER", allow_hyphen_values = true)]
    reward: Option<String>,
    /// Steps per second of the result [default: the task's control rate].
    #[arg(long, value_name = "HZ")]
    rate: Option<f64>,
    /// Steps per second of the recording, if the data set does not state them.
    #[arg(long, value_name = "HZ")]
    recorded_rate: Option<f64>,
    /// Read only the first episodes.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    episodes: Option<u32>,
}

impl ChosenArgs {
    fn words(&self) -> anyhow::Result<Vec<OsString>> {
        let mut words = match &self.task {
            Some(task) => task_words(self, task)?,
            None => Vec::new(),
        };
        let text = |value: &Option<String>| value.clone().map(OsString::from);
        let number = |value: Option<f64>| value.map(|value| value.to_string().into());
        for (flag, value) in [
            ("--observation", text(&self.observation)),
            ("--action-column", text(&self.action)),
            ("--reward", text(&self.reward)),
            ("--rate", number(self.rate)),
            ("--recorded-rate", number(self.recorded_rate)),
            ("--episodes", self.episodes.map(|count| count.to_string().into())),
        ] {
            if let Some(value) = value {
                let mut word = OsString::from(format!("{flag}="));
                word.push(value);
                words.push(word);
            }
        }
        Ok(words)
    }
}

pub(super) fn run(args: &DemosArgs) -> anyhow::Result<Outcome> {
    let (source, chosen) = match &args.action {
        Action::Show(show) => (&show.source, &show.chosen),
        Action::Convert(convert) => (&convert.source, &convert.chosen),
    };
    let mut words = chosen.words()?;
    if args.json {
        words.push("--json".into());
    }
    if matches!(args.action, Action::Convert(_)) {
        // The file is also for policies that use all of the range.
        words.push("--action-range=1".into());
    }
    let request = match &args.action {
        Action::Show(_) => vec!["show".into(), source.into()],
        Action::Convert(convert) => {
            vec!["convert".into(), source.into(), convert.output.clone().into()]
        }
    };
    emit(call(source, &words, &request)?.trim_end())?;
    Ok(Outcome::Done)
}

/// Returns true if `train` converts this source first: it is not a file.
pub(super) fn is_foreign(source: &str) -> bool {
    source.starts_with(MINARI) || Path::new(source).is_dir()
}

/// Returns the arguments of `dmprl.demos` for a task that is named on the command line.
fn task_words(args: &ChosenArgs, task: &str) -> anyhow::Result<Vec<OsString>> {
    let found = args.python_path.is_empty().then(|| project_folder(Path::new("."), task)).flatten();
    let folders = found.map_or_else(|| args.python_path.clone(), |folder| vec![folder]);
    let mut config = merge(&Sources {
        task,
        preset: PRESETS[0].name,
        file: None,
        environment: environment()?,
        set: &[],
        env_kwargs: &args.env_kwargs,
        flags: flag("--python-path", "task.python_path", paths("--python-path", &folders)?)
            .into_iter()
            .collect(),
    })?;
    config.demonstrations.files.clear(); // those of the environment variable, if it is set
    make_absolute(&mut config)?;
    Ok(words_of(&config))
}

/// Returns the arguments of `dmprl.demos` for the task of a configuration.
fn words_of(config: &ExperimentConfig) -> Vec<OsString> {
    let task = &config.task;
    let mut words = vec!["--task".into(), task.id.clone().into()];
    words.push(format!("--action-range={}", config.policy.action_range).into());
    words.extend(["--options".into(), task.options_toml().into()]);
    for folder in &task.python_path {
        words.extend(["--python-path".into(), folder.into()]);
    }
    words
}

/// Runs `dmprl.demos` and returns its standard output. If necessary, installs the packages that the
/// source needs.
fn call(source: &str, words: &[OsString], request: &[OsString]) -> anyhow::Result<String> {
    let python = if is_foreign(source) {
        prepare_python_with(EXTRA)?.1
    } else if Path::new(source).is_file() {
        python_of(&prepare_python()?)
    } else {
        return Err(wrong_use(format!("demonstrations {source}: no such file or folder")));
    };
    let mut command = Command::new(python);
    command.args(["-I", "-W", "ignore", "-m", "dmprl.demos"]).args(words).arg("--").args(request);
    let Output { status, stdout, stderr } =
        command.stdin(Stdio::null()).output().context("cannot start Python")?;
    let reason = String::from_utf8_lossy(&stderr).trim_end().to_owned();
    match status.code() {
        Some(0) => String::from_utf8(stdout).context("dmprl.demos did not print UTF-8"),
        Some(REFUSED) => Err(wrong_use(reason)),
        _ => Err(anyhow!("dmprl.demos ended with {status}:\n{reason}")),
    }
}

/// The sources among a run's demonstrations that must be converted.
pub(super) struct ForeignSources {
    /// Each with its index in `demonstrations.files`.
    sources: Vec<Foreign>,
    /// The converted files, until the run has a directory.
    folder: Option<TempDir>,
}

struct Foreign {
    index: usize,
    source: String,
    /// Name of the converted file in the run directory.
    file: String,
}

impl ForeignSources {
    /// Takes them out of a configuration, which then names only files.
    pub(super) fn take(config: &mut ExperimentConfig) -> Self {
        let files = std::mem::take(&mut config.demonstrations.files);
        let mut sources = Vec::new();
        for (index, source) in files.into_iter().enumerate() {
            if is_foreign(&source) {
                let file = format!("demonstrations-{}.npz", index + 1);
                sources.push(Foreign { index, source, file });
            } else {
                config.demonstrations.files.push(source);
            }
        }
        Self { sources, folder: None }
    }

    /// Converts them, and adds the files that they will be in the run directory `run` to the
    /// configuration.
    pub(super) fn convert(
        &mut self,
        config: &mut ExperimentConfig,
        run: &Path,
    ) -> anyhow::Result<()> {
        if self.sources.is_empty() {
            return Ok(());
        }
        let folder = tempfile::tempdir().context("cannot create a folder for demonstrations")?;
        let run = std::path::absolute(run).context("cannot find the current directory")?;
        for Foreign { index, source, file } in &self.sources {
            let mut words = words_of(config);
            words.push("--json".into());
            let output = folder.path().join(file).into_os_string();
            let printed = call(source, &words, &["convert".into(), source.into(), output])
                .map_err(|error| with_advice(error, source, &config.task.name))?;
            report(source, &serde_json::from_str(&printed).context("dmprl.demos")?);
            let path = run.join(file).into_os_string().into_string();
            let path = path.map_err(|path| wrong_use(format!("{}: not UTF-8", path.display())))?;
            config.demonstrations.files.insert(*index, path);
        }
        self.folder = Some(folder);
        Ok(())
    }

    /// Copies the converted files into the run directory.
    pub(super) fn copy_to(self, run: &Path) -> anyhow::Result<()> {
        let Some(folder) = self.folder else { return Ok(()) };
        for Foreign { file, .. } in &self.sources {
            // Not renamed, because the folder may be on another file system.
            std::fs::copy(folder.path().join(file), run.join(file))
                .with_context(|| format!("cannot write {}", run.join(file).display()))?;
        }
        Ok(())
    }
}

/// Adds the command with more flags to the error of a source that cannot be used as it is.
fn with_advice(error: anyhow::Error, source: &str, task: &str) -> anyhow::Error {
    match error.downcast::<WrongUse>() {
        Ok(WrongUse(reason)) => wrong_use(format!(
            "{reason}\n  flags for columns, rewards and rates: dmprl demos convert {source} \
             demos.npz --task {task}"
        )),
        Err(error) => error,
    }
}

/// Shows the result of a conversion.
fn report(source: &str, result: &serde_json::Value) {
    say(&format!(
        "demonstrations {source}: {} episodes, {} steps",
        result["episodes"], result["steps"]
    ));
    for note in result["notes"].as_array().into_iter().flatten() {
        say(&format!("demonstrations {source}: {}", note.as_str().unwrap_or_default()));
    }
}
