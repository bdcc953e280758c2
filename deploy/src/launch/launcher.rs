//! The command lines of the children.

use std::fmt::{self, Display, Formatter};
use std::fs::OpenOptions;
use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::SystemTime;

use anyhow::Context;

use crate::run_directory::{RunDirectory, rfc3339};

/// Incarnations that one session of the run has for each worker; a segment's sender is thus
/// never mistaken for one of an earlier session.
const INCARNATIONS_PER_SESSION: u32 = 1 << 16;

/// One of a run's children.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Process {
    /// The learner.
    Learner,
    /// A worker, by its index.
    Actor(u32),
    /// The evaluator.
    Evaluator,
}

impl Display for Process {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Learner => formatter.write_str("learner"),
            Self::Actor(index) => write!(formatter, "actor-{index}"),
            Self::Evaluator => formatter.write_str("evaluator"),
        }
    }
}

/// Everything that goes into the children's command lines.
#[derive(Debug, Clone)]
pub struct Launcher {
    /// This program; tests put a fake here.
    pub program: PathBuf,
    /// The run.
    pub run: RunDirectory,
    /// The Python virtual environment.
    pub venv: Option<PathBuf>,
    /// The shared-memory directory; none: learner, worker and evaluator are one process.
    pub domain: Option<PathBuf>,
    /// Whether the learner goes on from a checkpoint.
    pub resume: bool,
    /// The policy file of a warm start.
    pub init_from: Option<PathBuf>,
    /// Starts of the learner after a death, over the whole run.
    pub learner_restarts: u64,
    /// Sessions of this run before this one.
    pub sessions_before: u32,
    /// Where worker and learner note what they do, for `dmprl chaos`.
    pub journal: Option<PathBuf>,
}

impl Launcher {
    /// The command that starts `process` for the time after `restarts` restarts, its standard
    /// error appended to its log.
    ///
    /// # Errors
    /// The log cannot be opened.
    pub fn command(&self, process: Process, restarts: u32) -> anyhow::Result<Command> {
        let mut command = Command::new(&self.program);
        match process {
            Process::Learner => self.learner(&mut command),
            Process::Actor(index) => {
                let session = self.sessions_before.saturating_mul(INCARNATIONS_PER_SESSION);
                command.args(["actor", "--index", &index.to_string()]);
                command.args(["--incarnation", &session.saturating_add(restarts).to_string()]);
                command.arg("--run").arg(self.run.path());
            }
            Process::Evaluator => {
                command.arg("evaluator").arg("--run").arg(self.run.path());
            }
        }
        if let Some(journal) = self.journal.as_ref().filter(|_| process != Process::Evaluator) {
            command.arg("--journal").arg(journal);
        }
        if let Some(venv) = self.venv.as_ref().filter(|_| process != Process::Learner) {
            command.arg("--venv").arg(venv);
        }
        self.streams(command, &process.to_string())
    }

    /// The command of `dmprl eval`: an evaluator that leaves the run as it is.
    ///
    /// # Errors
    /// The log cannot be opened.
    pub fn evaluate(&self, episodes: u64) -> anyhow::Result<Command> {
        let mut command = Command::new(&self.program);
        command.args(["evaluator", "--print-only", "--episodes", &episodes.to_string()]);
        command.arg("--run").arg(self.run.path());
        if let Some(venv) = &self.venv {
            command.arg("--venv").arg(venv);
        }
        self.streams(command, "eval")
    }

    fn learner(&self, command: &mut Command) {
        command.arg("learner").arg("--run").arg(self.run.path());
        match &self.domain {
            Some(domain) => command.arg("--domain").arg(domain),
            None => command.arg("--one-process"),
        };
        if self.resume {
            command.arg("--resume");
        }
        if self.learner_restarts > 0 {
            command.args(["--restarts", &self.learner_restarts.to_string()]);
        }
        // A checkpoint holds all that the warm start gave.
        if let Some(file) = self.init_from.as_ref().filter(|_| !self.resume) {
            command.arg("--init-from").arg(file);
        }
        if let (None, Some(venv)) = (&self.domain, &self.venv) {
            command.arg("--venv").arg(venv);
        }
    }

    fn streams(&self, mut command: Command, name: &str) -> anyhow::Result<Command> {
        let path = self.run.log_path(name);
        let mut log = OpenOptions::new()
            .append(true)
            .create(true)
            .open(&path)
            .with_context(|| format!("cannot open {}", path.display()))?;
        // One log for all starts of a process: say where each begins.
        writeln!(log, "--- {name}, {} ---", rfc3339(SystemTime::now()))
            .with_context(|| format!("cannot write {}", path.display()))?;
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(log);
        Ok(command)
    }
}
