//! A role's end of the conversation with its supervisor.

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

use super::heartbeat::Pulse;
use crate::control::{Activity, Command, GROUP_SIGNALS, Report, WorkersNow};
use crate::terminal::say;

/// A worker or evaluator whose supervisor is gone has so long to end before it is killed.
pub const ORPHAN_LIMIT: Duration = Duration::from_secs(5);
/// The learner's limit: it writes a last checkpoint.
pub const ORPHANED_LEARNER_LIMIT: Duration = Duration::from_secs(60);

/// Commands not yet taken. The supervisor sends a handful in a run, one evaluation at a time;
/// one that does not fit is refused in the log.
const COMMANDS_MAX: usize = 64;
/// A longer line is no command.
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

/// Commands come in, reports go out; shareable between threads.
///
/// A thread reads the commands, so `stop` is seen while the role computes. When the supervisor
/// dies, whatever the manner, the input ends: the role is then orphaned and asked to stop, and
/// the thread kills the process if it is still there after the limit. No parent-death signal
/// is needed, and none is used: it would take the learner's last checkpoint away.
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
        ensure!((line.len() as u64) < LINE_BYTES_MAX, "a report of {} bytes", line.len());
        line.push(b'\n');
        let mut output = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        output.write_all(&line).and_then(|()| output.flush()).context("the supervisor is gone")
    }
}

impl ControlPipe {
    /// Takes over standard input and output and ignores the signals that a terminal or service
    /// manager sends to the whole process group: only the supervisor decides when a role ends.
    ///
    /// What anything else in this process prints, a user's environment above all, goes to
    /// standard error from now on: the log. What it reads is empty.
    ///
    /// # Errors
    /// The descriptors cannot be moved.
    pub fn open(orphan_limit: Duration) -> anyhow::Result<Self> {
        // Registering a handler that sets a flag nobody reads is ignoring, without `unsafe`.
        for signal in GROUP_SIGNALS {
            signal_hook::flag::register(signal, Arc::default())
                .with_context(|| format!("cannot ignore signal {signal}"))?;
        }
        let (input, output) = take_standard_streams().context("cannot move standard streams")?;
        Ok(Self::over(input, output, move || end_process_after(orphan_limit)))
    }

    /// The same over any pair of streams; `orphaned` runs on the reading thread at end of input.
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

    /// Whether to finish and exit: on `stop`, or because the supervisor is gone.
    #[must_use]
    pub fn stop_requested(&self) -> bool {
        self.flags.stop.load(Ordering::Acquire)
    }

    /// Whether to end the run as if it had all its steps.
    #[must_use]
    pub fn finish_requested(&self) -> bool {
        self.flags.finish.load(Ordering::Acquire)
    }

    /// The flag behind [`ControlPipe::stop_requested`], for handlers of signals.
    #[must_use]
    pub fn shared_stop_flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.flags.stop)
    }

    /// Failures of environments in the whole run; 0 before the supervisor has told of any.
    #[must_use]
    pub fn env_failures(&self) -> u64 {
        self.flags.env_failures.load(Ordering::Acquire)
    }

    /// What the supervisor knows of the workers; nothing before it has told of any.
    #[must_use]
    pub fn workers(&self) -> WorkersNow {
        *self.flags.workers.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What the workers did in the whole run; nothing before the supervisor has told of it.
    #[must_use]
    pub fn sent(&self) -> Sent {
        *self.flags.sent.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the supervisor is gone; reports then go nowhere.
    #[must_use]
    pub fn orphaned(&self) -> bool {
        self.flags.orphaned.load(Ordering::Acquire)
    }

    /// The next command, waiting so long for it; none when the wait or the input has ended. `stop`,
    /// `finish`, `env_failures`, `workers` and `sent` are no commands here: each has a method.
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

    /// What the loop's heartbeats leave for the thread that sends them.
    #[must_use]
    pub fn pulse(&self) -> Arc<Pulse> {
        Arc::clone(&self.pulse)
    }

    /// Sends reports too, for threads of their own.
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
        self.pulse.keep(segments as u64);
    }

    fn report(&self, report: &Report) -> Result<(), ReportError> {
        self.send(report).map_err(|error| ReportError(error.into()))
    }
}

/// Ends this process, whose supervisor is gone, unless it has ended by itself by then.
pub fn end_process_after(limit: Duration) {
    thread::sleep(limit);
    say("error: the supervisor is gone and this process did not end: killing it");
    // Not `exit`: destructors of a stuck library could hold it up for ever.
    let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::KILL);
}

fn take_standard_streams() -> std::io::Result<(File, File)> {
    let private = |fd| rustix::io::fcntl_dupfd_cloexec(fd, 3);
    let input = private(rustix::stdio::stdin())?;
    let output = private(rustix::stdio::stdout())?;
    detach_standard_streams()?;
    Ok((input.into(), output.into()))
}

/// From now on there is nothing to read, and what is printed goes to standard error.
pub fn detach_standard_streams() -> std::io::Result<()> {
    rustix::stdio::dup2_stdin(File::open("/dev/null")?)?;
    Ok(rustix::stdio::dup2_stdout(rustix::stdio::stderr())?)
}

/// Until the input ends or is broken, which is the same: nobody is there to be understood.
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
                    say(&format!(
                        "error: {COMMANDS_MAX} commands wait already, refused: {command:?}"
                    ));
                }
            },
            Err(error) => say(&format!("error: the supervisor sent what is no command: {error}")),
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
            assert!(Instant::now() < deadline, "waited {PATIENCE:?} in vain");
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
    fn a_report_is_one_line_and_fails_when_nobody_reads() {
        let (pipe, _commands, mut reports) = pipe(mpsc::channel().0);
        pipe.send(&Report::LearnerReady).unwrap();
        let mut line = String::new();
        reports.read_line(&mut line).unwrap();
        assert_eq!(line, "\"learner_ready\"\n");
        drop(reports);
        assert!(pipe.send(&Report::LearnerReady).is_err());
    }
}
