//! One child process: its commands go in, its reports and its end come out as events.

use std::os::fd::OwnedFd;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::ExitStatus;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use rustix::process::{Signal, pidfd_send_signal};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::io::{AsyncBufReadExt, AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, BufReader};
use tokio::sync::{Notify, mpsc};

use super::Process;
use super::joining::Newcomer;
use crate::control::{Command, ENV_HUNG_STATUS, GROUP_SIGNALS, JoinAnswer, Report};

/// Events not yet handled; full: children wait, their pipes fill.
pub(super) const EVENTS_MAX: usize = 1_024;
/// Commands not yet written; a child that takes none of so many is stuck.
const COMMANDS_MAX: usize = 64;
/// A longer line is no report.
const LINE_BYTES_MAX: u64 = 1 << 20;
/// After a child's exit its last reports are read for so long: a grandchild may hold the pipe.
const LAST_REPORTS: Duration = Duration::from_secs(1);
/// A worker that had joined and has closed its connection has so long to end by itself.
const SILENT_EXIT: Duration = Duration::from_secs(10);

/// What a child did.
#[derive(Debug)]
pub(super) enum Event {
    Report(Process, Report),
    /// It wrote a line that is no report.
    Garbage(Process, String),
    /// It is gone, and everything it reported has been handed over.
    Exited(Process, ExitStatus),
    /// A worker asks to join.
    Asked(Newcomer),
    /// A worker that had joined is gone, as `Exited`; its status is another's business.
    Gone(Process),
}

/// A running child. Dropping it kills the process when the runtime ends.
#[derive(Debug)]
pub(super) struct Child {
    commands: mpsc::Sender<Command>,
    kill: Arc<Notify>,
    /// The process's number.
    id: Option<u32>,
}

impl Child {
    /// Starts the command, whose three streams the launcher has set.
    pub(super) fn spawn(
        mut command: std::process::Command,
        process: Process,
        events: mpsc::Sender<Event>,
    ) -> anyhow::Result<Self> {
        start_deaf(&mut command);
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
                    // An error means that it has just ended: `wait` will say so.
                    () = killed.notified() => drop(child.start_kill()),
                }
            };
            if tokio::time::timeout(LAST_REPORTS, &mut reader).await.is_err() {
                reader.abort();
            }
            // Waiting fails only for a process that is no child of ours any more.
            let status = status.unwrap_or_else(|_| ExitStatus::from_raw(0xff00));
            // Nobody listens when the supervisor has given up: nothing left to tell.
            let _ = events.send(Event::Exited(process, status)).await;
        });
        Ok(Self { commands, kill, id })
    }

    /// Goes on with a worker that joins, which is told `answer` first. Its process is watched by
    /// its descriptor: a connection may be held open by what it has forked.
    pub(super) fn join(
        newcomer: Newcomer,
        answer: &JoinAnswer,
        process: Process,
        events: mpsc::Sender<Event>,
    ) -> anyhow::Result<Self> {
        let Newcomer { stream, process: descriptor, id, .. } = newcomer;
        // SAFETY: an owned descriptor is the same until it is dropped, and nobody else has it.
        let descriptor = unsafe { AsyncFd::register_with_interest(descriptor, Interest::READABLE) };
        let descriptor = descriptor.context("cannot watch its process")?;
        let mut answer = serde_json::to_vec(answer).context("cannot write an answer")?;
        answer.push(b'\n');
        let (input, mut output) = stream.into_split();
        let (commands, receiver) = mpsc::channel(COMMANDS_MAX);
        tokio::spawn(async move {
            if output.write_all(&answer).await.is_ok() {
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
                        grace = Box::pin(tokio::time::sleep(SILENT_EXIT));
                    }
                    // Without a connection it can only end.
                    () = &mut grace, if !listening => {
                        kill_by(&descriptor);
                        grace = Box::pin(tokio::time::sleep(SILENT_EXIT));
                    }
                }
            }
            if listening && tokio::time::timeout(LAST_REPORTS, &mut reader).await.is_err() {
                reader.abort();
            }
            let _ = events.send(Event::Gone(process)).await;
        });
        Ok(Self { commands, kill, id: u32::try_from(id).ok() })
    }

    /// The process's number; another's once it has ended and somebody needs a number.
    pub(super) fn id(&self) -> Option<u32> {
        self.id
    }

    /// Sends a command without waiting; false when the child takes none.
    pub(super) fn send(&self, command: Command) -> bool {
        self.commands.try_send(command).is_ok()
    }

    /// SIGKILL; the exit comes as an event.
    pub(super) fn kill(&self) {
        self.kill.notify_one();
    }
}

/// Has the child ignore from its first instruction on what a terminal or a service manager sends to
/// the whole group: only the supervisor decides when a role ends, and a Ctrl-C that meets a child
/// before it has set its own handlers must not look like the child's failure.
fn start_deaf(command: &mut std::process::Command) {
    let deafen = || {
        for signal in GROUP_SIGNALS {
            // SAFETY: `signal` is async-signal-safe and takes plain numbers.
            if unsafe { libc::signal(signal, libc::SIG_IGN) } == libc::SIG_ERR {
                return Err(std::io::Error::last_os_error());
            }
        }
        Ok(())
    };
    // SAFETY: between fork and exec the closure only calls `signal` and reads `errno`.
    unsafe { command.pre_exec(deafen) };
}

/// SIGKILL to the process of a descriptor; one that has ended already needs none.
fn kill_by(descriptor: &AsyncFd<OwnedFd>) {
    let _ = pidfd_send_signal(descriptor.get_ref(), Signal::KILL);
}

/// Until nobody sends commands or nobody reads them, of which the exit event tells.
async fn write_commands(mut input: impl AsyncWrite + Unpin, mut commands: mpsc::Receiver<Command>) {
    while let Some(command) = commands.recv().await {
        let Ok(mut line) = serde_json::to_vec(&command) else { return };
        line.push(b'\n');
        if input.write_all(&line).await.is_err() {
            return;
        }
    }
}

async fn read_reports(
    output: impl AsyncRead + Unpin,
    process: Process,
    events: mpsc::Sender<Event>,
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
            Ok(report) => Event::Report(process, report),
            Err(_) => Event::Garbage(process, String::from_utf8_lossy(&line).trim().to_owned()),
        };
        if events.send(event).await.is_err() {
            return;
        }
    }
}

/// `exit status 3`, `signal 9 (SIGKILL), perhaps for want of memory`.
pub(crate) fn describe(status: ExitStatus) -> String {
    let signal = match (status.code(), status.signal()) {
        (Some(ENV_HUNG_STATUS), _) => {
            return format!("exit status {ENV_HUNG_STATUS}, an environment hung");
        }
        (Some(code), _) => return format!("exit status {code}"),
        (None, Some(signal)) => signal,
        (None, None) => return status.to_string(),
    };
    let name = match signal {
        4 => " (SIGILL), an instruction this processor lacks",
        6 => " (SIGABRT)",
        7 => " (SIGBUS), perhaps because shared memory (/dev/shm) is full",
        9 => " (SIGKILL), perhaps for want of memory",
        11 => " (SIGSEGV), a fault in native code",
        15 => " (SIGTERM)",
        _ => "",
    };
    format!("signal {signal}{name}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_end_is_described_with_its_likely_cause() {
        assert_eq!(describe(ExitStatus::from_raw(3 << 8)), "exit status 3");
        assert!(describe(ExitStatus::from_raw(75 << 8)).contains("an environment hung"));
        assert!(describe(ExitStatus::from_raw(9)).contains("SIGKILL"));
        assert!(describe(ExitStatus::from_raw(7)).contains("/dev/shm"));
    }

    /// A learner that Ctrl-C met in its first milliseconds was once reported as dead.
    #[tokio::test]
    async fn the_signals_of_a_group_do_not_end_a_child_that_has_only_just_started() {
        let mut shell = std::process::Command::new("sh");
        shell.args(["-c", "kill -INT $$; kill -TERM $$; kill -HUP $$; exit 3"]);
        shell.stdin(std::process::Stdio::piped()).stdout(std::process::Stdio::piped());
        let (sender, mut events) = mpsc::channel(EVENTS_MAX);
        let _child = Child::spawn(shell, Process::Learner, sender).unwrap();
        let exited = tokio::time::timeout(Duration::from_secs(10), events.recv()).await;
        match exited.expect("an exit within 10 s") {
            Some(Event::Exited(Process::Learner, status)) => assert_eq!(status.code(), Some(3)),
            other => panic!("expected its exit, got {other:?}"),
        }
    }
}
