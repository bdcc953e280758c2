//! A child process: accepts commands, and turns its reports and its exit into events.

use std::os::fd::OwnedFd;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::ExitStatus;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use dmprl_control::{Command, GROUP_SIGNALS, Greeting, JoinAnswer, Report};
use rustix::process::{Signal, pidfd_send_signal};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::io::{AsyncBufReadExt, AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::sync::{Notify, mpsc};

use super::process::Process;

/// Maximum number of events in the queue. If it is full, reading stops and pipes fill.
pub(super) const EVENTS_MAX: usize = 1_024;
/// Maximum number of commands in a child's queue. A child whose queue is full is stuck.
const COMMANDS_MAX: usize = 64;
/// Maximum length of a report.
const LINE_BYTES_MAX: u64 = 1 << 20;
/// Maximum time for reading the last reports after a child's exit: a grandchild may hold the pipe
/// open.
const LAST_REPORTS_LIMIT: Duration = Duration::from_secs(1);
/// Time limit for the exit of a joined worker that closed its connection. Then it is killed.
const SILENT_EXIT_LIMIT: Duration = Duration::from_secs(10);
/// Maximum time for writing a rejection.
const REFUSAL_LIMIT: Duration = Duration::from_secs(5);

/// An event from outside the supervisor.
#[derive(Debug)]
pub(super) enum Incoming {
    Child(Process, ChildEvent),
    /// A worker asks to join.
    Join(PendingJoin),
}

/// An event of a child.
#[derive(Debug)]
pub(super) enum ChildEvent {
    Report(Report),
    /// The child wrote a line that is not a report.
    Garbage(String),
    /// The child exited, and all its reports have been sent.
    Exited(ExitStatus),
    /// Like `Exited`, for a worker that had joined. Only its parent knows its exit status.
    Gone,
}

/// A worker that waits for the answer to its request to join.
#[derive(Debug)]
pub(super) struct PendingJoin {
    pub(super) stream: UnixStream,
    /// Descriptor of the process, which never refers to another process.
    pub(super) process: OwnedFd,
    /// Process id, for messages.
    pub(super) id: i32,
    /// Version of the worker's program.
    pub(super) speaks: Greeting,
}

impl PendingJoin {
    /// Sends the reason and closes the connection.
    pub(super) fn refuse(mut self, reason: String) {
        tokio::spawn(async move {
            let answer = JoinAnswer::Refused { reason };
            // Fails harmlessly if the worker has exited.
            let written = write_line(&mut self.stream, &answer);
            let _ = tokio::time::timeout(REFUSAL_LIMIT, written).await;
        });
    }
}

/// A running child. The runtime kills it when it shuts down.
#[derive(Debug)]
pub(super) struct Child {
    commands: mpsc::Sender<Command>,
    kill: Arc<Notify>,
    id: Option<u32>,
}

impl Child {
    /// Starts the command. The launcher has set its standard streams.
    pub(super) fn spawn(
        mut command: std::process::Command,
        process: Process,
        events: mpsc::Sender<Incoming>,
    ) -> anyhow::Result<Self> {
        ignore_group_signals(&mut command);
        let mut command = tokio::process::Command::from(command);
        command.kill_on_drop(true);
        let mut child = command.spawn().with_context(|| {
            format!("cannot start {process} ({:?})", command.as_std().get_program())
        })?;
        let id = child.id();
        let input = child.stdin.take().context("a child without standard input")?;
        let output = child.stdout.take().context("a child without standard output")?;
        let (commands, receiver) = mpsc::channel(COMMANDS_MAX);
        tokio::spawn(write_commands(input, receiver));
        let mut reader = tokio::spawn(read_reports(output, process, events.clone()));
        let kill = Arc::new(Notify::new());
        let killed = Arc::clone(&kill);
        tokio::spawn(async move {
            let status = loop {
                tokio::select! {
                    status = child.wait() => break status,
                    // An error means that it has just exited: `wait` will return.
                    () = killed.notified() => drop(child.start_kill()),
                }
            };
            if tokio::time::timeout(LAST_REPORTS_LIMIT, &mut reader).await.is_err() {
                reader.abort();
            }
            // Waiting fails only for a process that is no longer a child of this one.
            let status = status.unwrap_or_else(|_| ExitStatus::from_raw(0xff00));
            // The channel is closed if the supervisor has given up.
            let _ = events.send(Incoming::Child(process, ChildEvent::Exited(status))).await;
        });
        Ok(Self { commands, kill, id })
    }

    /// Admits a worker that joins, and sends it `answer`. Detects its exit by the descriptor of its
    /// process, because a process that it has forked may hold the connection open.
    pub(super) fn join(
        pending: PendingJoin,
        answer: &JoinAnswer,
        process: Process,
        events: mpsc::Sender<Incoming>,
    ) -> anyhow::Result<Self> {
        let PendingJoin { stream, process: descriptor, id, .. } = pending;
        // SAFETY: an owned descriptor stays the same until it is dropped, and has no other owner.
        let descriptor = unsafe { AsyncFd::register_with_interest(descriptor, Interest::READABLE) };
        let descriptor = descriptor.context("cannot monitor its process")?;
        let answer = answer.clone();
        let (input, mut output) = stream.into_split();
        let (commands, receiver) = mpsc::channel(COMMANDS_MAX);
        tokio::spawn(async move {
            if write_line(&mut output, &answer).await.is_ok() {
                write_commands(output, receiver).await;
            }
        });
        let mut reader = tokio::spawn(read_reports(input, process, events.clone()));
        let kill = Arc::new(Notify::new());
        let killed = Arc::clone(&kill);
        tokio::spawn(async move {
            let mut listening = true;
            let mut grace = Box::pin(tokio::time::sleep(Duration::MAX));
            loop {
                tokio::select! {
                    _ = descriptor.readable() => break,
                    () = killed.notified() => kill_by(&descriptor),
                    _ = &mut reader, if listening => {
                        listening = false;
                        grace = Box::pin(tokio::time::sleep(SILENT_EXIT_LIMIT));
                    }
                    // A worker without a connection must exit.
                    () = &mut grace, if !listening => {
                        kill_by(&descriptor);
                        grace = Box::pin(tokio::time::sleep(SILENT_EXIT_LIMIT));
                    }
                }
            }
            if listening && tokio::time::timeout(LAST_REPORTS_LIMIT, &mut reader).await.is_err() {
                reader.abort();
            }
            let _ = events.send(Incoming::Child(process, ChildEvent::Gone)).await;
        });
        Ok(Self { commands, kill, id: u32::try_from(id).ok() })
    }

    /// Returns the process id. After the exit, the system may assign it to another process.
    pub(super) fn id(&self) -> Option<u32> {
        self.id
    }

    /// Sends a command without waiting; returns false if the queue is full or the child is gone.
    pub(super) fn send(&self, command: Command) -> bool {
        self.commands.try_send(command).is_ok()
    }

    /// Sends SIGKILL; the exit arrives as an event.
    pub(super) fn kill(&self) {
        self.kill.notify_one();
    }
}

/// Makes the child ignore, from its start, the signals that a terminal or a service manager sends
/// to the whole group: only the supervisor decides when a role ends. Otherwise a Ctrl-C before the
/// child has set its own handlers would look like a failure of the child.
fn ignore_group_signals(command: &mut std::process::Command) {
    let ignore = || {
        for signal in GROUP_SIGNALS {
            // SAFETY: `signal` is async-signal-safe and takes plain numbers.
            if unsafe { libc::signal(signal, libc::SIG_IGN) } == libc::SIG_ERR {
                return Err(std::io::Error::last_os_error());
            }
        }
        Ok(())
    };
    // SAFETY: between fork and exec the closure only calls `signal` and reads `errno`.
    unsafe { command.pre_exec(ignore) };
}

/// Sends SIGKILL to the process of a descriptor; does nothing if the process has exited.
fn kill_by(descriptor: &AsyncFd<OwnedFd>) {
    let _ = pidfd_send_signal(descriptor.get_ref(), Signal::KILL);
}

/// Writes a value as a line of JSON.
pub(super) async fn write_line<W: AsyncWrite + Unpin>(
    output: &mut W,
    value: &impl serde::Serialize,
) -> anyhow::Result<()> {
    let mut line = serde_json::to_vec(value)?;
    line.push(b'\n');
    Ok(output.write_all(&line).await?)
}

/// Writes commands until the supervisor drops the sender or the child closes its input.
async fn write_commands(mut input: impl AsyncWrite + Unpin, mut commands: mpsc::Receiver<Command>) {
    while let Some(command) = commands.recv().await {
        if write_line(&mut input, &command).await.is_err() {
            return;
        }
    }
}

async fn read_reports(
    output: impl AsyncRead + Unpin,
    process: Process,
    events: mpsc::Sender<Incoming>,
) {
    let mut reader = BufReader::new(output);
    let mut line = Vec::new();
    loop {
        line.clear();
        match (&mut reader).take(LINE_BYTES_MAX).read_until(b'\n', &mut line).await {
            Ok(read) if read > 0 => {}
            _ => return,
        }
        let event = match serde_json::from_slice(&line) {
            Ok(report) => ChildEvent::Report(report),
            Err(_) => ChildEvent::Garbage(String::from_utf8_lossy(&line).trim().to_owned()),
        };
        if events.send(Incoming::Child(process, event)).await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: a learner that received Ctrl-C in its first milliseconds was once reported
    /// as dead.
    #[tokio::test]
    async fn group_signals_do_not_end_a_child_that_has_just_started() {
        let mut shell = std::process::Command::new("sh");
        shell.args(["-c", "kill -INT $$; kill -TERM $$; kill -HUP $$; exit 3"]);
        shell.stdin(std::process::Stdio::piped()).stdout(std::process::Stdio::piped());
        let (sender, mut events) = mpsc::channel(EVENTS_MAX);
        let _child = Child::spawn(shell, Process::Learner, sender).unwrap();
        let exited = tokio::time::timeout(Duration::from_secs(10), events.recv()).await;
        match exited.expect("an exit within 10 s") {
            Some(Incoming::Child(Process::Learner, ChildEvent::Exited(status))) => {
                assert_eq!(status.code(), Some(3));
            }
            other => panic!("expected its exit, got {other:?}"),
        }
    }
}
