//! Builds the command lines of the children.

use std::fs::OpenOptions;
use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::SystemTime;

use anyhow::Context;
use dmprl_run::{RunDirectory, rfc3339};

use super::process::Process;

/// Number of incarnations of each worker in a session of the run. Sessions use disjoint ranges, so
/// the learner can distinguish a segment's sender from those of earlier sessions.
pub(super) const INCARNATIONS_PER_SESSION: u32 = 1 << 16;

/// Parameters of the children's command lines.
#[derive(Debug, Clone)]
pub struct Launcher {
    /// This program, or a fake in tests.
    pub program: PathBuf,
    /// The run.
    pub run: RunDirectory,
    /// The Python virtual environment.
    pub venv: Option<PathBuf>,
    /// The shared-memory directory; `None` if learner, worker and evaluator are one process.
    pub domain: Option<PathBuf>,
    /// Whether the learner resumes from a checkpoint.
    pub resume: bool,
    /// The policy file of a warm start.
    pub init_from: Option<PathBuf>,
    /// Restarts of the learner after a death, in the whole run.
    pub learner_restarts: u64,
    /// Sessions of this run before this one.
    pub sessions_before: u32,
    /// Directory of the journals of workers and learner, for `dmprl chaos`.
    pub journal: Option<PathBuf>,
    /// The learner's host, on a host without a learner.
    pub upstream: Option<Upstream>,
}

/// Connection of a host without a learner to the learner's host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Upstream {
    /// The Zenoh endpoint.
    pub endpoint: String,
    /// The file with the run's secret.
    pub token_file: PathBuf,
    /// Random number that identifies this host to the learner's host.
    pub host: u64,
    /// Name of this host in displays.
    pub name: String,
    /// Index in the run of this host's first worker.
    pub first: u32,
    /// Zenoh configuration file.
    pub zenoh_file: Option<PathBuf>,
    /// Maximum time for which the learner's host may be unreachable \[s\].
    pub patience_s: u64,
}

impl Launcher {
    /// The process to which workers send: the learner, or the relay on a host without one.
    #[must_use]
    pub fn hub(&self) -> Process {
        if self.upstream.is_some() { Process::Relay } else { Process::Learner }
    }

    /// Creates a launcher for single children outside training.
    #[must_use]
    pub fn outside_training(program: PathBuf, run: &RunDirectory, venv: Option<PathBuf>) -> Self {
        Self {
            program,
            run: run.clone(),
            venv,
            domain: None,
            resume: false,
            init_from: None,
            learner_restarts: 0,
            sessions_before: 0,
            journal: None,
            upstream: None,
        }
    }

    /// Computes a worker's incarnation from the number of its start in this session, from 0.
    /// Incarnations of a worker increase over all sessions of the run.
    ///
    /// # Errors
    /// The run has had too many sessions, or the worker too many starts.
    pub fn incarnation(&self, start: u32) -> anyhow::Result<u32> {
        let first = self.sessions_before.checked_mul(INCARNATIONS_PER_SESSION);
        let first = first.filter(|_| start < INCARNATIONS_PER_SESSION);
        first.and_then(|first| first.checked_add(start)).with_context(|| {
            format!(
                "start {start} of a worker in session {} of the run: the limits are \
                 {INCARNATIONS_PER_SESSION} starts in each of {INCARNATIONS_PER_SESSION} sessions",
                self.sessions_before
            )
        })
    }

    /// Builds the command that starts `process`, with standard error appended to its log. `start`
    /// is the number of the start in this session, from 0.
    ///
    /// # Errors
    /// The log cannot be opened, or a worker has been started too often.
    pub fn command(&self, process: Process, start: u32) -> anyhow::Result<Command> {
        let mut command = Command::new(&self.program);
        match process {
            Process::Learner => self.learner(&mut command),
            Process::Relay => self.relay(&mut command),
            Process::Gateway => {
                command.arg("gateway").arg("--run").arg(self.run.path());
                command.args(["--session", &self.sessions_before.to_string()]);
                command.arg("--domain").args(&self.domain);
            }
            Process::Actor(index) => {
                command.args(["actor", "--index", &index.to_string()]);
                command.args(["--incarnation", &self.incarnation(start)?.to_string()]);
                command.arg("--run").arg(self.run.path());
                if let Some(upstream) = &self.upstream {
                    command.args(["--first", &upstream.first.to_string()]);
                }
            }
            Process::Evaluator => {
                command.arg("evaluator").arg("--run").arg(self.run.path());
            }
        }
        let notes = matches!(process, Process::Learner | Process::Actor(_));
        if let Some(journal) = self.journal.as_ref().filter(|_| notes) {
            command.arg("--journal").arg(journal);
        }
        let python = matches!(process, Process::Evaluator | Process::Actor(_));
        if let Some(venv) = self.venv.as_ref().filter(|_| python) {
            command.arg("--venv").arg(venv);
        }
        self.streams(command, &process.to_string())
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
        // A checkpoint includes the result of the warm start.
        if let Some(file) = self.init_from.as_ref().filter(|_| !self.resume) {
            command.arg("--init-from").arg(file);
        }
        if let (None, Some(venv)) = (&self.domain, &self.venv) {
            command.arg("--venv").arg(venv);
        }
    }

    fn relay(&self, command: &mut Command) {
        let Some(upstream) = &self.upstream else { return };
        command.arg("relay").arg("--run").arg(self.run.path());
        command.arg("--domain").args(&self.domain);
        command.args(["--connect", &upstream.endpoint, "--name", &upstream.name]);
        command.arg("--token-file").arg(&upstream.token_file);
        for (flag, number) in [
            ("--host", upstream.host),
            ("--first", upstream.first.into()),
            ("--session", self.sessions_before.into()),
            ("--patience", upstream.patience_s),
        ] {
            command.args([flag, &number.to_string()]);
        }
        if let Some(file) = &upstream.zenoh_file {
            command.arg("--zenoh-config").arg(file);
        }
    }

    /// Sets a command's standard streams: pipes for input and output, and the log of `name` for
    /// errors.
    ///
    /// # Errors
    /// The log cannot be opened.
    pub(super) fn streams(&self, mut command: Command, name: &str) -> anyhow::Result<Command> {
        let path = self.run.log_path(name);
        let mut log = OpenOptions::new()
            .append(true)
            .create(true)
            .open(&path)
            .with_context(|| format!("cannot open {}", path.display()))?;
        // All starts of a process share a log: mark the beginning of each.
        writeln!(log, "--- {name}, {} ---", rfc3339(SystemTime::now()))
            .with_context(|| format!("cannot write {}", path.display()))?;
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(log);
        Ok(command)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dmprl_run::Manifest;

    #[test]
    fn incarnations_of_a_run_are_unique() {
        let folder = tempfile::tempdir().unwrap();
        let manifest = Manifest::new(None).unwrap();
        let run = RunDirectory::create(&folder.path().join("run"), &Default::default(), &manifest);
        let mut launcher = Launcher {
            program: PathBuf::new(),
            run: run.unwrap(),
            venv: None,
            domain: None,
            resume: false,
            init_from: None,
            learner_restarts: 0,
            sessions_before: 0,
            journal: None,
            upstream: None,
        };
        let last = INCARNATIONS_PER_SESSION - 1;
        assert_eq!([0, last].map(|start| launcher.incarnation(start).unwrap()), [0, last]);
        assert!(launcher.incarnation(last + 1).is_err());
        launcher.sessions_before = 1;
        assert_eq!(launcher.incarnation(0).unwrap(), last + 1);
        launcher.sessions_before = last;
        assert_eq!(launcher.incarnation(last).unwrap(), u32::MAX);
        launcher.sessions_before = last + 1;
        let error = launcher.incarnation(0).unwrap_err().to_string();
        assert!(error.contains("session 65536 of the run"), "{error}");
    }
}
