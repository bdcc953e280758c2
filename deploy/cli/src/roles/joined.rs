//! A worker that joins a running training: `dmprl actor --join RUN`.
//!
//! It requests a place from the supervisor (`deploy/supervisor/src/joining.rs`) and then works
//! like the others. On the first Ctrl-C it delivers its segments before it leaves; a second Ctrl-C
//! ends it at once.

use std::cell::Cell;
use std::fs;
use std::io::{Read, Write};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_actors::worker::JoinedWorker;
use dmprl_control::{ControlPipe, ORPHAN_LIMIT, detach_standard_streams, end_process_after};
use dmprl_control::{
    GROUP_SIGNALS, Greeting, JOIN_SOCKET, JoinAnswer, JoinRequest, Report, Welcome,
};
use dmprl_run::RunDirectory;
use dmprl_run::Setup;
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::{grouped, shown};
use dmprl_run::is_ignored;
use dmprl_shared::transport::delivery::Sent;
use dmprl_supervisor::Place;
use signal_hook::flag;

use super::actor::{self, WorkerStart};
use crate::terminal::say;

/// Time limit for an answer. A supervisor answers at once unless it is suspended.
const ANSWER_LIMIT: Duration = Duration::from_secs(10);
/// Maximum length of an answer in bytes.
const ANSWER_BYTES_MAX: u64 = 1 << 16;
/// Interval between two lines of progress.
const PRINT_INTERVAL: Duration = Duration::from_secs(5);
/// Exit status after a second Ctrl-C.
const INTERRUPTED_STATUS: i32 = 130;

/// Joins a run and works for it until the run ends or the user stops the worker.
///
/// # Errors
/// The run accepts no worker, or the worker fails.
pub fn join(run: &Path) -> anyhow::Result<Outcome> {
    check_owner(run)?;
    let setup = Setup::read(run)?;
    check_accepts_workers(&setup)?;
    let leaving = Arc::new(AtomicBool::new(false));
    let stream = connect(&setup.run)?;
    let welcome = ask(&stream, &setup.run)?;
    let commands = stream.try_clone().context("cannot share the connection")?;
    let control = ControlPipe::over(commands, stream, || end_process_after(ORPHAN_LIMIT));
    detach_standard_streams().context("cannot move standard streams")?;
    leave_on_signals(&leaving, &control)?;
    let Welcome { index, incarnation, venv, workers } = welcome;
    let counted = format!("{workers} worker{}", if workers == 1 { "" } else { "s" });
    say(&format!("joined {} as actor-{index}: {counted}", shown(setup.run.path())));
    let printer = ProgressPrinter::new();
    let report_sent = |sent| printer.print(sent);
    let venv = venv.as_deref();
    let start = WorkerStart { setup: &setup, index, first: 0, incarnation, venv, journal: None };
    let joined = JoinedWorker { leaving: &leaving, report_sent: &report_sent };
    actor::work(&start, &control, Some(joined))?;
    let sent = printer.sent.get();
    let acknowledged = format!("{} of {}", grouped(sent.acked), grouped(sent.produced));
    let segments = format!("{acknowledged} segments acknowledged");
    if leaving.load(Ordering::Acquire) {
        // The supervisor may be gone.
        let _ = control.send(&Report::Left);
        say(&format!("left the run: {segments}"));
        return Ok(Outcome::Interrupted);
    }
    if control.orphaned() {
        bail!("the supervisor of {} is gone; {segments}", shown(setup.run.path()));
    }
    say(&format!("the run has ended: {segments}"));
    Ok(Outcome::Done)
}

fn check_owner(run: &Path) -> anyhow::Result<()> {
    // If the directory does not exist, opening it will report that.
    let Ok(metadata) = fs::metadata(run) else { return Ok(()) };
    let user = rustix::process::geteuid().as_raw();
    if metadata.uid() != user {
        return Err(wrong_use(format!(
            "run {} belongs to user {}, you are user {user}: only its owner's workers may join",
            run.display(),
            metadata.uid()
        )));
    }
    Ok(())
}

fn check_accepts_workers(setup: &Setup) -> anyhow::Result<()> {
    let (config, run) = (&setup.config, shown(setup.run.path()));
    if config.run.deterministic {
        return Err(wrong_use(format!(
            "run {run} is deterministic: it has one process and accepts no other workers"
        )));
    }
    if config.actors.joined_max == 0 {
        return Err(wrong_use(format!("run {run} accepts no workers: its actors.joined_max is 0")));
    }
    Ok(())
}

/// Connects to the supervisor. The run's lock contains the supervisor's process id, and this and
/// the run id determine the shared-memory directory, which contains the socket.
fn connect(run: &RunDirectory) -> anyhow::Result<UnixStream> {
    let not_trained = || {
        format!(
            "run {} is not training on this machine; resume it first: dmprl resume {}",
            shown(run.path()),
            shown(run.path())
        )
    };
    let supervisor = run.lock_holder().with_context(not_trained)?;
    let token = dmprl_supervisor::domain_token(&run.manifest()?, supervisor.pid);
    let domain: PathBuf = Place::of_this_user().find(&token).with_context(not_trained)?;
    let stream = UnixStream::connect(domain.join(JOIN_SOCKET)).with_context(not_trained)?;
    stream.set_read_timeout(Some(ANSWER_LIMIT)).context("cannot limit the wait for an answer")?;
    Ok(stream)
}

fn ask(mut stream: &UnixStream, run: &RunDirectory) -> anyhow::Result<Welcome> {
    let answer = || -> anyhow::Result<Vec<u8>> {
        let (mut line, mut input, mut byte) = (Vec::new(), stream.take(ANSWER_BYTES_MAX), [0]);
        // Byte by byte, because the control pipe reads what follows the line.
        while !line.ends_with(b"\n") {
            let read = input.read(&mut byte);
            if read.with_context(|| format!("no answer within {ANSWER_LIMIT:?}"))? == 0 {
                bail!("it closed the connection");
            }
            line.extend(byte);
        }
        Ok(line)
    };
    let asked = || format!("the supervisor of {} did not answer", shown(run.path()));
    // Parse only the greeting first: other messages may differ between versions.
    let greeting: Greeting =
        serde_json::from_slice(&answer().with_context(asked)?).with_context(asked)?;
    let this = Greeting::this();
    if greeting != this {
        bail!(
            "run {} is trained by {greeting}, this program is {this}: join it with that program",
            shown(run.path())
        );
    }
    let mut request = serde_json::to_vec(&JoinRequest { speaks: this })?;
    request.push(b'\n');
    stream.write_all(&request).with_context(asked)?;
    let welcome = match serde_json::from_slice(&answer().with_context(asked)?)? {
        JoinAnswer::Welcome(welcome) => welcome,
        JoinAnswer::Refused { reason } => {
            bail!("run {} accepts no worker now: {reason}", shown(run.path()))
        }
    };
    stream.set_read_timeout(None).context("cannot wait for commands")?;
    Ok(welcome)
}

/// Installs signal handlers: the first signal makes the worker leave, the second ends it at once.
fn leave_on_signals(leaving: &Arc<AtomicBool>, control: &ControlPipe) -> anyhow::Result<()> {
    // A hang-up that is ignored, as by `nohup`, stays ignored. An interrupt does not: shells ignore
    // it for background jobs only to shield them from the terminal's Ctrl-C.
    let handled = |signal: &i32| *signal != libc::SIGHUP || !is_ignored(*signal);
    for signal in GROUP_SIGNALS.into_iter().filter(handled) {
        // In this order: the first signal must not count as the second.
        flag::register_conditional_shutdown(signal, INTERRUPTED_STATUS, Arc::clone(leaving))
            .and_then(|_| flag::register(signal, Arc::clone(leaving)))
            .and_then(|_| flag::register(signal, control.shared_stop_flag()))
            .with_context(|| format!("cannot catch signal {signal}"))?;
    }
    Ok(())
}

/// Prints the counts of segments at intervals.
struct ProgressPrinter {
    started: Instant,
    printed_at: Cell<Option<Instant>>,
    sent: Cell<Sent>,
}

impl ProgressPrinter {
    fn new() -> Self {
        Self {
            started: Instant::now(),
            printed_at: Cell::new(None),
            sent: Cell::new(Sent::default()),
        }
    }

    fn print(&self, sent: Sent) {
        let first = self.sent.replace(sent).sent == 0 && sent.sent > 0;
        let due = self.printed_at.get().is_none_or(|at| at.elapsed() >= PRINT_INTERVAL);
        if sent.sent > 0 && (first || due) {
            self.printed_at.set(Some(Instant::now()));
            say(&format!(
                "after {:.1} s: {} segments sent, {} acknowledged",
                self.started.elapsed().as_secs_f64(),
                grouped(sent.sent),
                grouped(sent.acked)
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;
    use dmprl_run::Manifest;

    /// Joins at a supervisor that sends these lines.
    fn join_at(lines: &[&str]) -> anyhow::Result<Welcome> {
        let lines: Vec<String> = lines.iter().map(ToString::to_string).collect();
        let folder = tempfile::tempdir().unwrap();
        let manifest = Manifest::new(None).unwrap();
        let run = RunDirectory::create(&folder.path().join("run"), &Default::default(), &manifest);
        let (ours, mut theirs) = UnixStream::pair().unwrap();
        let supervisor = thread::spawn(move || {
            lines.iter().for_each(|line| writeln!(theirs, "{line}").unwrap());
            // Returns when the other end is closed.
            theirs.read_to_end(&mut Vec::new()).unwrap();
        });
        let answer = ask(&ours, &run.unwrap());
        drop(ours);
        supervisor.join().unwrap();
        answer
    }

    #[test]
    fn an_error_names_the_version_of_another_supervisor() {
        let error = join_at(&[r#"{"version":"9.9.9","control":7,"new":1}"#]);
        let error = error.unwrap_err().to_string();
        assert!(error.contains("is trained by dmprl 9.9.9 (protocol 7)"), "{error}");
        assert!(error.contains(env!("CARGO_PKG_VERSION")), "{error}");
    }

    #[test]
    fn a_rejection_is_reported_with_its_reason() {
        let greeting = concat!(r#"{"version":""#, env!("CARGO_PKG_VERSION"), r#"","control":1}"#);
        let lines = &[greeting, r#"{"refused":{"reason":"it is full"}}"#];
        let error = join_at(lines).unwrap_err().to_string();
        assert!(error.contains("accepts no worker now: it is full"), "{error}");
    }
}
