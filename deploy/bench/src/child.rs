//! A child process that exchanges lines of text with this process and ends with it.

use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::mpsc::{self, Receiver, SyncSender, TryRecvError};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use dmprl_run::Watch;
use dmprl_run::{describe, last_lines};
use serde::Deserialize;

/// Capacity for received lines. When it is full, the child blocks.
const LINES_MAX: usize = 64;
/// Maximum length of a line, far above that of any line in the protocol.
const LINE_BYTES_MAX: u64 = 1 << 20;
/// Time for a child to exit by itself after it closed its output or stopped reading its input,
/// before it is killed. Its own exit status is more informative.
const EXIT_GRACE: Duration = Duration::from_secs(1);
/// Interval between checks for the exit.
const EXIT_POLL_INTERVAL: Duration = Duration::from_millis(5);

/// First line that a peer sends.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Greeting {
    Ready(String),
    Absent(String),
}

/// Peak resident memory of a process in bytes (`VmHWM`), if the system reports it.
/// - `process`: its id, or `self`.
pub(super) fn resident_bytes_max(process: &str) -> Option<u64> {
    bytes_of(process, "VmHWM:")
}

/// Current resident memory of this process in bytes (`VmRSS`), if the system reports it. It
/// includes shared memory that this process has touched.
pub(super) fn resident_bytes() -> Option<u64> {
    bytes_of("self", "VmRSS:")
}

fn bytes_of(process: &str, field: &str) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(field))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

/// Processor time of a thread, from its folder below `/proc` [s].
fn cpu_s(folder: &Path) -> Option<f64> {
    let text = std::fs::read_to_string(folder.join("schedstat")).ok()?;
    text.split_whitespace().next()?.parse::<f64>().ok().map(|nanoseconds| nanoseconds * 1e-9)
}

/// A running child process, killed and reaped on drop. It holds nothing that a kill could damage.
/// If this process is killed, the child exits at the end of its input.
pub(super) struct LineChild {
    name: String,
    child: Child,
    input: ChildStdin,
    lines: Receiver<String>,
    log: PathBuf,
    started: Instant,
}

impl LineChild {
    /// Starts `command`, whose standard error already goes to `log`.
    pub(super) fn start(name: String, mut command: Command, log: &Path) -> anyhow::Result<Self> {
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let started = Instant::now();
        let program = command.get_program().to_owned();
        let mut child =
            command.spawn().with_context(|| format!("cannot start {name} ({program:?})"))?;
        let (sender, lines) = mpsc::sync_channel(LINES_MAX);
        let streams = (child.stdin.take(), child.stdout.take());
        let (Some(input), Some(output)) = streams else {
            // Unreachable: both are piped above.
            let _ = child.kill();
            return Err(anyhow!("{name} has no standard input or output"));
        };
        // Reading a line has no timeout, so a thread does it. It exits at the end of the output.
        thread::spawn(move || read_lines(output, &sender));
        Ok(Self { name, child, input, lines, log: log.to_owned(), started })
    }

    /// Returns the child's name, for messages.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Returns the child's start time.
    pub(super) fn started(&self) -> Instant {
        self.started
    }

    /// Sends one line to the child.
    pub(super) fn send_line(&mut self, line: &str) -> anyhow::Result<()> {
        let result = writeln!(self.input, "{line}").and_then(|()| self.input.flush());
        result.map_err(|_| self.exit_error())
    }

    /// Receives the next line from the child.
    pub(super) fn next_line(
        &mut self,
        watch: &Watch,
        limit: Duration,
        what: &str,
    ) -> anyhow::Result<String> {
        self.next_line_if_any(watch, limit, what)?.ok_or_else(|| self.exit_error())
    }

    /// Receives the next line, or `None` if the child has exited without one.
    pub(super) fn next_line_if_any(
        &mut self,
        watch: &Watch,
        limit: Duration,
        what: &str,
    ) -> anyhow::Result<Option<String>> {
        let next = watch.next(&self.lines, limit, &format!("{what} of {}", self.name));
        next.with_context(|| last_lines(&self.log).trim().to_owned())
    }

    /// Receives the first line: a description, or the reason why this peer is unavailable. A
    /// missing interpreter or package only removes the peer from the benchmark.
    pub(super) fn greeting(
        &mut self,
        watch: &Watch,
        limit: Duration,
    ) -> anyhow::Result<Result<String, String>> {
        let Some(line) = self.next_line_if_any(watch, limit, "the first line")? else {
            return Ok(Err(self.exit_summary()));
        };
        Ok(match serde_json::from_str(&line) {
            Ok(Greeting::Ready(text)) => Ok(text),
            Ok(Greeting::Absent(why)) => Err(why),
            Err(_) => Err(self.unexpected_line(&line).to_string()),
        })
    }

    /// The error for a line that is not part of the protocol.
    pub(super) fn unexpected_line(&self, line: &str) -> anyhow::Error {
        anyhow!("{} sent an unexpected line: {line}", self.name)
    }

    /// Returns the lines received so far, without waiting.
    pub(super) fn received_lines(&mut self) -> anyhow::Result<Vec<String>> {
        let mut lines = Vec::new();
        loop {
            match self.lines.try_recv() {
                Ok(line) => lines.push(line),
                Err(TryRecvError::Empty) => return Ok(lines),
                Err(TryRecvError::Disconnected) => return Err(self.exit_error()),
            }
        }
    }

    /// Peak resident memory in bytes (`VmHWM`), if the system reports it.
    pub(super) fn resident_bytes_max(&self) -> Option<u64> {
        resident_bytes_max(&self.child.id().to_string())
    }

    /// Processor time of its first thread so far [s], if the system reports it.
    pub(super) fn cpu_s(&self) -> Option<f64> {
        cpu_s(&PathBuf::from(format!("/proc/{}", self.child.id())))
    }

    /// Processor time of all its threads so far [s], if the system reports it.
    pub(super) fn cpu_s_of_all_threads(&self) -> Option<f64> {
        let threads = std::fs::read_dir(format!("/proc/{}/task", self.child.id())).ok()?;
        threads.map(|thread| cpu_s(&thread.ok()?.path())).sum()
    }

    /// Ends the child and returns an error with its exit status and the last lines of its log,
    /// because the log is deleted with the benchmark's folder.
    fn exit_error(&mut self) -> anyhow::Error {
        let how = self.wait_or_kill();
        let lines = last_lines(&self.log);
        anyhow!("{} died: {how}\n  last lines of its log:\n{lines}", self.name)
    }

    /// Ends the child. Describes its exit in one line, with the last line of its log.
    pub(super) fn exit_summary(&mut self) -> String {
        let how = self.wait_or_kill();
        let lines = last_lines(&self.log);
        let last = lines.lines().map(str::trim).rfind(|line| !line.is_empty());
        format!("it died: {how}{}", last.map_or_else(String::new, |line| format!(", {line}")))
    }

    /// Waits for the child to exit, kills it after [`EXIT_GRACE`], and describes its exit status.
    fn wait_or_kill(&mut self) -> String {
        let deadline = Instant::now() + EXIT_GRACE;
        while Instant::now() < deadline {
            if let Ok(Some(status)) = self.child.try_wait() {
                return describe(status);
            }
            thread::sleep(EXIT_POLL_INTERVAL);
        }
        let _ = self.child.kill();
        self.child.wait().map_or_else(|error| error.to_string(), describe)
    }
}

impl Drop for LineChild {
    fn drop(&mut self) {
        // Fails if the child has already exited.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn read_lines(output: ChildStdout, lines: &SyncSender<String>) {
    let mut reader = BufReader::new(output);
    let mut line = String::new();
    loop {
        line.clear();
        match (&mut reader).take(LINE_BYTES_MAX).read_line(&mut line) {
            Ok(read) if read > 0 => {}
            _ => return,
        }
        if lines.send(line.trim_end().to_owned()).is_err() {
            return;
        }
    }
}
