//! One run of a sweep: its directory and its process.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Instant;

use anyhow::Context;
use dmprl_run::format::shown;
use dmprl_run::sweep_files::{Ledger, PlannedRun, flatten};
use dmprl_run::{RunDirectory, replace_file};
use dmprl_run::{describe, last_lines};
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::supervision::EvaluationRow;
use rustix::process::{Pid, Signal, kill_process};
use tokio::process::{Child, Command};
use toml::Value;

/// The file of a run directory that is written last.
const MANIFEST: &str = "manifest.json";

/// Output directory of a sweep, and the program that trains its runs.
#[derive(Debug, Clone)]
pub struct Site {
    /// The `dmprl` binary, started for each run.
    pub program: PathBuf,
    /// Output directory of the sweep.
    pub output: PathBuf,
    /// The sweep file's text.
    pub text: String,
    /// Returns the environment steps in a run's newest checkpoint; 0 without a checkpoint.
    pub checkpointed_steps: fn(&RunDirectory) -> anyhow::Result<u64>,
}

/// Progress of a run.
#[derive(Debug, Clone, PartialEq)]
pub enum RunState {
    /// Not started, or stopped.
    Open {
        /// Environment steps in its newest checkpoint.
        env_steps: u64,
    },
    /// Completed.
    Finished,
    /// Ended with an error.
    Failed {
        /// Reason, with the last lines of its log.
        reason: String,
    },
}

impl Site {
    /// Copies the sweep file into the output directory. The report takes the names of the runs from
    /// the copy, so all existing runs must have been checked against the file before.
    pub(super) fn save_sweep_file(&self) -> anyhow::Result<()> {
        replace_file(&self.output.join("sweep.toml"), self.text.as_bytes())
    }

    /// Returns the progress of a run from the files in its directory.
    pub(super) fn state(
        &self,
        ledger: &Ledger,
        run: &PlannedRun,
        config: &ExperimentConfig,
    ) -> anyhow::Result<RunState> {
        let path = self.output.join(&run.directory);
        if !is_complete(&path) {
            return Ok(RunState::Open { env_steps: 0 });
        }
        let directory = RunDirectory::open(&path)?;
        let mut found = directory.config()?;
        // The only key that may differ: a run can be resumed with more steps.
        found.run.steps = config.run.steps;
        check_same(&path, config, &found)?;
        if ledger.of(&run.directory).is_some_and(|done| done.is_whole(config.run.steps)) {
            return Ok(RunState::Finished);
        }
        Ok(RunState::Open { env_steps: (self.checkpointed_steps)(&directory)? })
    }

    /// Returns the environment steps in the newest line of a run's metrics; 0 if it cannot be read.
    pub(super) fn measured_steps(&self, run: &PlannedRun) -> u64 {
        let directory = RunDirectory::open(&self.output.join(&run.directory));
        directory.and_then(|directory| directory.measured_steps()).ok().flatten().unwrap_or(0)
    }

    /// Returns the evaluations of a run, oldest first; empty while its directory is incomplete.
    pub(super) fn evaluations(&self, run: &PlannedRun) -> anyhow::Result<Vec<EvaluationRow>> {
        let path = self.output.join(&run.directory);
        if is_complete(&path) { RunDirectory::open(&path)?.evaluations() } else { Ok(Vec::new()) }
    }

    /// Returns the training time in seconds and the last evaluation of a finished run.
    pub(super) fn final_result(
        &self,
        run: &PlannedRun,
    ) -> anyhow::Result<(f64, Option<EvaluationRow>)> {
        let directory = RunDirectory::open(&self.output.join(&run.directory))?;
        Ok((directory.wall_s_before()?, directory.latest_row()?))
    }

    /// Describes the failure of a run's process, with the last lines of its log.
    pub(super) fn failure(&self, run: &PlannedRun, status: ExitStatus) -> String {
        let log = self.log_path(run);
        format!("{}; {}:\n{}", describe(status), shown(&log), last_lines(&log))
    }

    fn log_path(&self, run: &PlannedRun) -> PathBuf {
        let name: Vec<_> =
            run.directory.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        self.output.join("logs").join(format!("{}.log", name.join("-")))
    }

    /// Returns a shell command that starts a run, or resumes it once its directory exists. A batch
    /// system may therefore repeat the command.
    #[must_use]
    pub fn shell_command(&self, run: &PlannedRun, config: &ExperimentConfig) -> String {
        let path = self.output.join(&run.directory);
        let command = |arguments: Vec<OsString>| {
            let program = [self.program.clone().into_os_string()];
            shell_words(&program.into_iter().chain(arguments).collect::<Vec<_>>())
        };
        format!(
            "if [ -e {} ]; then {}; else {}; fi",
            shell_words(&[path.join(MANIFEST).into()]),
            command(resume_arguments(&path, config)),
            command(train_arguments(&path, run)),
        )
    }

    /// Starts or resumes a run that has `env_steps` in its newest checkpoint.
    pub(super) fn start(
        &self,
        run: &PlannedRun,
        config: &ExperimentConfig,
        env_steps: u64,
    ) -> anyhow::Result<RunProcess> {
        let path = self.output.join(&run.directory);
        let mut command = std::process::Command::new(&self.program);
        if !is_complete(&path) && path.exists() {
            set_aside(&path)?;
        }
        command.args(match is_complete(&path) {
            true => resume_arguments(&path, config),
            false => train_arguments(&path, run),
        });
        command.stdin(Stdio::null()).stdout(Stdio::null());
        command.stderr(open_log(&self.log_path(run))?);
        let child = background_command(command).spawn()?;
        Ok(RunProcess { child, started: Instant::now(), env_steps })
    }
}

/// Returns the arguments that resume a run.
fn resume_arguments(path: &Path, config: &ExperimentConfig) -> Vec<OsString> {
    let steps = config.run.steps.to_string();
    let flags = ["--steps".into(), steps.into(), "--no-progress".into()];
    ["resume".into(), path.into()].into_iter().chain(flags).collect()
}

/// Returns the arguments that start a run.
fn train_arguments(path: &Path, run: &PlannedRun) -> Vec<OsString> {
    let planned = run.arguments.iter().map(Into::into);
    let flags = ["--run-dir".into(), path.into(), "--no-progress".into()];
    ["train".into()].into_iter().chain(planned).chain(flags).collect()
}

/// Joins words to a shell command. Words with other than harmless characters are quoted.
fn shell_words(words: &[OsString]) -> String {
    let harmless = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+@".contains(c);
    let quoted = words.iter().map(|word| {
        let word = word.to_string_lossy();
        match !word.is_empty() && word.chars().all(harmless) {
            true => word.into_owned(),
            false => format!("'{}'", word.replace('\'', r"'\''")),
        }
    });
    quoted.collect::<Vec<_>>().join(" ")
}

/// Prepares a child that gets no signals from the terminal, and SIGTERM when this process dies.
pub(super) fn background_command(mut command: std::process::Command) -> Command {
    // This process forwards interrupts; from the terminal the child would get them twice.
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    let mut command = Command::from(command);
    // SAFETY: `prctl` is async-signal-safe, allocates nothing and touches no lock.
    unsafe {
        command.pre_exec(|| {
            // If the sweep is killed, its runs write a checkpoint and stop.
            rustix::process::set_parent_process_death_signal(Some(Signal::TERM)).map_err(Into::into)
        });
    }
    command
}

/// The process of a run.
pub(super) struct RunProcess {
    pub(super) child: Child,
    started: Instant,
    /// Environment steps done before the process started.
    pub(super) env_steps: u64,
}

impl RunProcess {
    /// Returns the environment steps since the process started, and the seconds they took. This
    /// includes the start-up time, which the next runs will need too.
    pub(super) fn measured(&self, reached: u64) -> (u64, f64) {
        (reached.saturating_sub(self.env_steps), self.started.elapsed().as_secs_f64())
    }

    /// Interrupts the run. On the first interrupt it writes a checkpoint and exits; on the second
    /// it exits at once.
    pub(super) fn interrupt(&self) {
        let id = self.child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
        // Fails only if the process has already exited.
        let _ = id.map(|id| kill_process(id, Signal::INT));
    }
}

/// Returns true if a run directory is complete: the manifest is written last.
fn is_complete(path: &Path) -> bool {
    path.join(MANIFEST).is_file()
}

/// Rejects a run with another configuration: one table entry must not mix the results of both.
fn check_same(
    path: &Path,
    expected: &ExperimentConfig,
    found: &ExperimentConfig,
) -> anyhow::Result<()> {
    if expected == found {
        return Ok(());
    }
    let keys = |config: &ExperimentConfig| -> BTreeMap<_, _> {
        flatten(&toml::Table::try_from(config).unwrap_or_default()).into_iter().collect()
    };
    let (expected, found) = (keys(expected), keys(found));
    let text = |value: Option<&Value>| value.map_or("not set".to_owned(), Value::to_string);
    let differing = expected.keys().chain(found.keys()).find_map(|key| {
        let (there, here) = (found.get(key), expected.get(key));
        let (there_text, here_text) = (text(there), text(here));
        (there != here).then(|| format!("{key} is {there_text} there and {here_text} in the sweep"))
    });
    anyhow::bail!(
        "{} was trained with another configuration: {}; set the same in the sweep file (a default \
         may have changed with the program), remove the run, or choose another --output",
        shown(path),
        differing.unwrap_or_default()
    )
}

/// Renames a run directory whose creation was interrupted, keeping its content.
fn set_aside(path: &Path) -> anyhow::Result<()> {
    let name = |number: u32| path.with_extension(format!("unfinished-{number}"));
    let free = (0..).map(name).find(|name| !name.exists());
    let aside = free.context("no unused name is left")?;
    std::fs::rename(path, &aside).with_context(|| format!("cannot rename {}", path.display()))
}

/// Opens a log for appending, so that the output of earlier processes is kept.
pub(super) fn open_log(path: &Path) -> anyhow::Result<File> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot create {}", folder.display()))?;
    }
    let file = OpenOptions::new().append(true).create(true).open(path);
    file.with_context(|| format!("cannot open {}", path.display()))
}

/// Describes an evaluation for a message.
pub(super) fn evaluation_text(row: &EvaluationRow) -> String {
    let success =
        row.success_rate.map(|rate| format!(", success {:.0} %", rate * 100.0)).unwrap_or_default();
    format!("return {:.2}{success}", row.return_mean)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_with_other_arguments_of_its_environment_is_rejected() {
        let mut config = ExperimentConfig::default();
        let (path, without) = (Path::new("run"), config.clone());
        check_same(path, &config, &without).unwrap();
        config.task.kwargs.insert("reward_type".to_owned(), "dense".into());
        let error = |expected, found| check_same(path, expected, found).unwrap_err().to_string();
        let key = "task.kwargs.reward_type is";
        let there = error(&config, &without);
        assert!(there.contains(&format!("{key} not set there and \"dense\"")), "{there}");
        let here = error(&without, &config);
        assert!(here.contains(&format!("{key} \"dense\" there and not set")), "{here}");
    }

    #[test]
    fn words_of_a_shell_command_are_quoted_where_necessary() {
        let words = ["train", "a b", "--set", "task.id=x:Y-v0", "it's", ""].map(OsString::from);
        assert_eq!(shell_words(&words), r"train 'a b' --set task.id=x:Y-v0 'it'\''s' ''");
    }
}
