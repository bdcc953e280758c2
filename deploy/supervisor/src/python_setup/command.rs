//! Runs `venv` and `pip`, with progress, and reports their failures.

use std::{
    collections::VecDeque,
    ffi::OsStr,
    fs::File,
    io::{self, BufRead, BufReader},
    path::Path,
    process::{Command, ExitStatus, Stdio},
    sync::mpsc::{self, RecvTimeoutError},
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, Result, bail};
use dmprl_actors::python_env::LINKED_PYTHON;

use super::{advice::advice, environment::PythonEnvironment, locks, requirement::EDITABLE, stamp};

/// Maximum number of lines of a failed command in its error.
const LAST_LINES_MAX: usize = 20;
/// Interval between progress lines of a command that prints nothing.
const PROGRESS_INTERVAL: Duration = Duration::from_secs(1);
/// Maximum number of lines queued between the reading thread and the progress. If the queue is
/// full, the command blocks.
const QUEUED_LINES_MAX: usize = 256;

/// A set-up of an environment in progress.
pub(super) struct Setup<'a> {
    /// The environment to create.
    pub environment: &'a PythonEnvironment,
    /// The lock, held until the last command that writes into it has ended.
    pub lock: &'a File,
    /// Called with each progress line.
    pub progress: &'a dyn Fn(&str),
}

impl Setup<'_> {
    /// Creates the virtual environment with the interpreter against which this program is linked.
    pub fn create(&self) -> Result<()> {
        stamp::begin(&self.environment.venv)?;
        let mut command = Command::new(LINKED_PYTHON.executable);
        command.args(["-I", "-m", "venv"]).arg(&self.environment.venv);
        let name = self.environment.venv.file_name().unwrap_or_default().to_string_lossy();
        let phase = format!("creating {name} with Python {}", LINKED_PYTHON.version_number());
        self.run(&phase, command)
    }

    /// Installs the package: the locked versions of its requirements, and then the package itself.
    ///
    /// The installation is editable: it refers to `envs_py`, so changed tasks need no installation.
    /// The build tool is one of the locked packages, so that pip does not fetch another version.
    pub fn install(&self, package: &Path) -> Result<()> {
        self.install_locked("installing packages", &locks::base(package))?;
        let package: [&OsStr; 3] =
            ["--no-build-isolation".as_ref(), "--editable".as_ref(), package.as_ref()];
        self.pip_install("installing dmprl", &package)
    }

    /// Installs the packages of a lock. pip refuses files with other hashes.
    pub fn install_locked(&self, phase: &str, lock: &Path) -> Result<()> {
        let arguments: [&OsStr; 3] =
            ["--require-hashes".as_ref(), "--requirement".as_ref(), lock.as_ref()];
        self.pip_install(phase, &arguments)
    }

    /// Installs the packages of a requirements file.
    pub fn install_listed(&self, requirements: &Path) -> Result<()> {
        self.pip_install("installing packages", &["--requirement".as_ref(), requirements.as_ref()])
    }

    /// Installs these requirements, in pip's syntax, in versions that go with each other. Otherwise
    /// pip fails without a change. It keeps installed versions that are good enough.
    pub fn install_together(&self, requirements: &[String]) -> Result<()> {
        let mut arguments: Vec<&OsStr> = Vec::new();
        for requirement in requirements {
            match requirement.strip_prefix(EDITABLE) {
                Some(path) => arguments.extend([OsStr::new("--editable"), path.as_ref()]),
                None => arguments.push(requirement.as_ref()),
            }
        }
        self.pip_install(&format!("installing {}", requirements.join(" ")), &arguments)
    }

    /// Uninstalls these packages.
    pub fn uninstall(&self, names: &[String]) -> Result<()> {
        let mut command = self.pip("uninstall");
        command.arg("--yes").args(names);
        self.run(&format!("removing {}", names.join(" ")), command)
    }

    fn pip_install(&self, phase: &str, arguments: &[&OsStr]) -> Result<()> {
        let mut command = self.pip("install");
        command.args(["--progress-bar", "off"]).args(arguments);
        self.run(phase, command)
    }

    fn pip(&self, subcommand: &str) -> Command {
        let mut command = Command::new(&self.environment.executable);
        command
            .args(["-I", "-m", "pip", subcommand, "--disable-pip-version-check", "--no-input"])
            // Settings of a user's pip.conf that fail in a virtual environment or bypass it.
            .env("PIP_USER", "0")
            .env_remove("PIP_TARGET")
            .env_remove("PIP_PREFIX");
        command
    }

    fn run(&self, phase: &str, mut command: Command) -> Result<()> {
        let started = Instant::now();
        let line = command_line(&command);
        let (output, input) = io::pipe().context("cannot create a pipe")?;
        command
            // The lock file is empty, so it serves as empty input. The command thereby holds the
            // lock until it exits: if this program is killed, the next start waits.
            .stdin(Stdio::from(self.lock.try_clone().context("cannot share the lock")?))
            .stdout(input.try_clone().context("cannot share the pipe")?)
            .stderr(input);
        let mut child = command.spawn().with_context(|| format!("cannot run {line}"))?;
        drop(command); // it holds the pipe's writing end
        let last_lines = self.follow(phase, started, BufReader::new(output));
        let status = child.wait().with_context(|| format!("cannot wait for {line}"))?;
        check(&line, status, &last_lines)
    }

    /// Shows a command's output as progress until the command closes it; returns the last lines.
    fn follow(
        &self,
        phase: &str,
        started: Instant,
        output: impl BufRead + Send + 'static,
    ) -> VecDeque<String> {
        let (sender, receiver) = mpsc::sync_channel(QUEUED_LINES_MAX);
        // Read in a thread, because reading a line has no timeout.
        let reader = thread::spawn(move || {
            for line in output.split(b'\n').map_while(Result::ok) {
                if sender.send(String::from_utf8_lossy(&line).trim_end().to_owned()).is_err() {
                    return;
                }
            }
        });
        let mut last_lines = VecDeque::with_capacity(LAST_LINES_MAX);
        loop {
            match receiver.recv_timeout(PROGRESS_INTERVAL) {
                Ok(line) if line.is_empty() => continue,
                Ok(line) => {
                    if last_lines.len() == LAST_LINES_MAX {
                        last_lines.pop_front();
                    }
                    last_lines.push_back(line);
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            let last = last_lines.back().map_or("", |line: &String| line.trim_start());
            let seconds = started.elapsed().as_secs();
            (self.progress)(&format!("python environment: {phase} ({seconds} s) {last}"));
        }
        // The thread has dropped its sender, so it ends.
        let _ = reader.join();
        last_lines
    }
}

fn check(line: &str, status: ExitStatus, last_lines: &VecDeque<String>) -> Result<()> {
    if status.success() {
        return Ok(());
    }
    let output: Vec<&str> = last_lines.iter().map(String::as_str).collect();
    let output = output.join("\n");
    bail!("{}{line} failed ({status}):\n{output}", advice(&output))
}

fn command_line(command: &Command) -> String {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    words.map(|word| word.to_string_lossy()).collect::<Vec<_>>().join(" ")
}
