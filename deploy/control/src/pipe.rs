//! The control pipe: a role's connection to its supervisor.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, SyncSender, TrySendError};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use anyhow::{Context, ensure};
use dmprl_shared::supervision::{ReportError, RunTotals, Supervisor};
use dmprl_shared::transport::delivery::Sent;
use tracing::error;

use super::heartbeat::Pulse;
use crate::{Activity, Command, GROUP_SIGNALS, Report, WorkersNow};

/// Time limit for a worker or evaluator to exit after its supervisor is gone.
pub const ORPHAN_LIMIT: Duration = Duration::from_secs(5);
/// Time limit for the learner, which first writes a last checkpoint.
pub const ORPHANED_LEARNER_LIMIT: Duration = Duration::from_secs(60);

/// Maximum number of commands in the queue. The supervisor sends few, and one evaluation at a time.
/// A command that does not fit is dropped with a log line.
const COMMANDS_MAX: usize = 64;
/// Maximum length of a line in bytes.
const LINE_BYTES_MAX: u64 = 1 << 20;

#[derive(Debug, Default)]
struct Flags {
    stop: Arc<AtomicBool>,
    finish: AtomicBool,
    orphaned: AtomicBool,
    env_failures: AtomicU64,
    workers: Mutex<WorkersNow>,
    sent: Mutex<Sent>,
}

/// Receives commands and sends reports, from any thread.
///
/// A thread reads the commands, so `stop` takes effect while the role computes. When the supervisor
/// dies for any reason, the input ends. The role is then orphaned and must stop, and the thread
/// kills the process after a time limit. A parent-death signal would kill the learner before its
/// last checkpoint.
pub struct ControlPipe {
    commands: Mutex<Receiver<Command>>,
    flags: Arc<Flags>,
    reporter: Reporter,
    pulse: Arc<Pulse>,
}

/// Sends reports, from any thread.
#[derive(Clone)]
pub struct Reporter(Arc<Mutex<Box<dyn Write + Send>>>);

impl Reporter {
    /// Sends one report.
    ///
    /// # Errors
    /// The supervisor is gone.
    pub fn send(&self, report: &Report) -> anyhow::Result<()> {
        let mut line = serde_json::to_vec(report).context("cannot write a report as JSON")?;
        ensure!(
            (line.len() as u64) < LINE_BYTES_MAX,
            "a report has {} bytes; expected fewer than {LINE_BYTES_MAX}",
            line.len()
        );
        line.push(b'\n');
        let mut output = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        output.write_all(&line).and_then(|()| output.flush()).context("the supervisor is gone")
    }
}

impl ControlPipe {
    /// Takes over standard input and output, and ignores the signals that a terminal or service
    /// manager sends to the whole process group: only the supervisor decides when a role ends.
    ///
    /// From now on, output of other code in this process, such as a user's environment, goes to
    /// standard error, the log, and its input is empty.
    ///
    /// # Errors
    /// The descriptors cannot be moved.
    pub fn open(orphan_limit: Duration) -> anyhow::Result<Self> {
        // Ignores the signal without `unsafe`: the handler sets a flag that is never read.
        for signal in GROUP_SIGNALS {
            signal_hook::flag::register(signal, Arc::default())
                .with_context(|| format!("cannot ignore signal {signal}"))?;
        }
        let (input, output) = take_standard_streams().context("cannot move standard streams")?;
        Ok(Self::over(input, output, move || end_process_after(orphan_limit)))
    }

    /// Creates a pipe over any pair of streams. Calls `orphaned` on the reading thread at end of
    /// input.
    pub fn over(
        input: impl Read + Send + 'static,
        output: impl Write + Send + 'static,
        orphaned: impl FnOnce() + Send + 'static,
    ) -> Self {
        let flags = Arc::new(Flags::default());
        let (sender, commands) = mpsc::sync_channel(COMMANDS_MAX);
        let seen = Arc::clone(&flags);
        thread::spawn(move || {
            read_commands(input, &sender, &seen);
            seen.orphaned.store(true, Ordering::Release);
            seen.stop.store(true, Ordering::Release);
            drop(sender);
            orphaned();
        });
        let reporter = Reporter(Arc::new(Mutex::new(Box::new(output))));
        let pulse = Arc::new(Pulse::new(Activity::Attaching));
        Self { commands: Mutex::new(commands), flags, reporter, pulse }
    }

    /// Returns true if the role must finish and exit: after `stop`, or if the supervisor is gone.
    #[must_use]
    pub fn stop_requested(&self) -> bool {
        self.flags.stop.load(Ordering::Acquire)
    }

    /// Returns true if the run must end as if it had completed all steps.
    #[must_use]
    pub fn finish_requested(&self) -> bool {
        self.flags.finish.load(Ordering::Acquire)
    }

    /// Returns the flag of [`ControlPipe::stop_requested`], for signal handlers.
    #[must_use]
    pub fn shared_stop_flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.flags.stop)
    }

    /// Returns the number of environment failures in the whole run, as last sent by the supervisor.
    #[must_use]
    pub fn env_failures(&self) -> u64 {
        self.flags.env_failures.load(Ordering::Acquire)
    }

    /// Returns the state of the workers, as last sent by the supervisor.
    #[must_use]
    pub fn workers(&self) -> WorkersNow {
        *self.flags.workers.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the counts of the workers' segments in the whole run, as last sent by the
    /// supervisor.
    #[must_use]
    pub fn sent(&self) -> Sent {
        *self.flags.sent.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns true if the supervisor is gone. Reports then fail.
    #[must_use]
    pub fn orphaned(&self) -> bool {
        self.flags.orphaned.load(Ordering::Acquire)
    }

    /// Waits up to `wait` for the next command; returns `None` at the time limit or at end of
    /// input. `stop`, `finish`, `env_failures`, `workers` and `sent` are not returned: each has a
    /// method.
    #[must_use]
    pub fn next_within(&self, wait: Duration) -> Option<Command> {
        self.commands.lock().unwrap_or_else(PoisonError::into_inner).recv_timeout(wait).ok()
    }

    /// Sends one report.
    ///
    /// # Errors
    /// The supervisor is gone.
    pub fn send(&self, report: &Report) -> anyhow::Result<()> {
        self.reporter.send(report)
    }

    /// Returns the state of the loop, for the thread that sends heartbeats.
    #[must_use]
    pub fn pulse(&self) -> Arc<Pulse> {
        Arc::clone(&self.pulse)
    }

    /// Returns another sender of reports, for a separate thread.
    #[must_use]
    pub fn reporter(&self) -> Reporter {
        self.reporter.clone()
    }
}

impl Supervisor for ControlPipe {
    fn stop_flag(&self) -> &AtomicBool {
        &self.flags.stop
    }

    fn finish_requested(&self) -> bool {
        self.flags.finish.load(Ordering::Acquire)
    }

    fn is_gone(&self) -> bool {
        self.orphaned()
    }

    fn next_command(&self, wait: Duration) -> Option<Command> {
        self.next_within(wait)
    }

    fn totals(&self) -> RunTotals {
        let (env_failures, workers, sent) = (self.env_failures(), self.workers(), self.sent());
        RunTotals { env_failures, workers, sent }
    }

    fn heartbeat(&self, doing: Activity) {
        self.pulse.beat(doing);
    }

    fn note_unacknowledged(&self, segments: usize) {
        self.pulse.set_kept(segments as u64);
    }

    fn report(&self, report: &Report) -> Result<(), ReportError> {
        self.send(report).map_err(|error| ReportError(error.into()))
    }
}

/// Kills this process after `limit`, because its supervisor is gone.
pub fn end_process_after(limit: Duration) {
    thread::sleep(limit);
    error!("the supervisor is gone and this process did not exit in time; killing it");
    // Not `exit`, because destructors of a hanging library could block forever.
    let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::KILL);
}

fn take_standard_streams() -> std::io::Result<(File, File)> {
    let private = |fd| rustix::io::fcntl_dupfd_cloexec(fd, 3);
    let input = private(rustix::stdio::stdin())?;
    let output = private(rustix::stdio::stdout())?;
    detach_standard_streams()?;
    Ok((input.into(), output.into()))
}

/// Redirects standard input from `/dev/null` and standard output to standard error.
pub fn detach_standard_streams() -> std::io::Result<()> {
    rustix::stdio::dup2_stdin(File::open("/dev/null")?)?;
    Ok(rustix::stdio::dup2_stdout(rustix::stdio::stderr())?)
}

/// Reads commands until end of input or a read error; either way the supervisor is gone.
fn read_commands(input: impl Read, sender: &SyncSender<Command>, flags: &Flags) {
    let mut reader = BufReader::new(input);
    let mut line = Vec::new();
    loop {
        line.clear();
        match (&mut reader).take(LINE_BYTES_MAX).read_until(b'\n', &mut line) {
            Ok(read) if read > 0 && line.ends_with(b"\n") => {}
            _ => return,
        }
        match serde_json::from_slice(&line) {
            Ok(Command::Stop) => flags.stop.store(true, Ordering::Release),
            Ok(Command::Finish) => flags.finish.store(true, Ordering::Release),
            Ok(Command::EnvFailures { total }) => {
                flags.env_failures.store(total, Ordering::Release);
            }
            Ok(Command::Workers(now)) => {
                *flags.workers.lock().unwrap_or_else(PoisonError::into_inner) = now;
            }
            Ok(Command::Sent(total)) => {
                *flags.sent.lock().unwrap_or_else(PoisonError::into_inner) = total;
            }
            Ok(command) => match sender.try_send(command) {
                Ok(()) | Err(TrySendError::Disconnected(_)) => {}
                Err(TrySendError::Full(command)) => {
                    error!("dropped a command because {COMMANDS_MAX} are queued: {command:?}");
                }
            },
            Err(error) => error!("the supervisor sent an invalid command: {error}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::Sender;
    use std::time::Instant;

    const PATIENCE: Duration = Duration::from_secs(30);

    fn pipe(orphaned: Sender<()>) -> (ControlPipe, impl Write, impl BufRead) {
        let (input, commands) = std::io::pipe().unwrap();
        let (reports, output) = std::io::pipe().unwrap();
        let pipe = ControlPipe::over(input, output, move || orphaned.send(()).unwrap());
        (pipe, commands, BufReader::new(reports))
    }

    fn until(condition: impl Fn() -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !condition() {
            assert!(Instant::now() < deadline, "not within {PATIENCE:?}");
            thread::yield_now();
        }
    }

    #[test]
    fn commands_arrive_in_order_and_stop_overtakes_them() {
        let (pipe, mut commands, _reports) = pipe(mpsc::channel().0);
        commands.write_all(b"nonsense\n{\"attach\":{\"domain\":\"/a\"}}\n").unwrap();
        commands.write_all(b"{\"env_failures\":{\"total\":3}}\n\"stop\"\n").unwrap();
        until(|| pipe.stop_requested());
        assert_eq!(pipe.env_failures(), 3);
        assert!(!pipe.orphaned());
        let attach = Command::Attach { domain: "/a".into() };
        assert_eq!(pipe.next_within(PATIENCE), Some(attach));
        assert_eq!(pipe.next_within(Duration::ZERO), None);
    }

    #[test]
    fn end_of_input_means_orphaned_and_stop() {
        let (sender, orphaned) = mpsc::channel();
        let (pipe, commands, _reports) = pipe(sender);
        assert!(!pipe.stop_requested());
        drop(commands);
        orphaned.recv_timeout(PATIENCE).unwrap();
        assert!(pipe.stop_requested() && pipe.orphaned());
        assert_eq!(pipe.next_within(PATIENCE), None);
    }

    #[test]
    fn a_report_is_one_line_and_fails_if_the_reader_is_gone() {
        let (pipe, _commands, mut reports) = pipe(mpsc::channel().0);
        pipe.send(&Report::LearnerReady).unwrap();
        let mut line = String::new();
        reports.read_line(&mut line).unwrap();
        assert_eq!(line, "\"learner_ready\"\n");
        drop(reports);
        assert!(pipe.send(&Report::LearnerReady).is_err());
    }
}
