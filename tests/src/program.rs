//! Runs the program as a user does: real processes with a deadline.
//!
//! Only this file finds the executable, and starts and awaits it.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::OnceLock;
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use rustix::process::{Pid, Signal, kill_process, kill_process_group};
use serde_json::Value;
use tempfile::TempDir;

use crate::processes::any_is_dying;
pub use crate::processes::{Process, process_naming, processes_naming};
pub use crate::run_files::{
    env_steps, env_steps_of, env_steps_of_checkpoint, json_file, rows, shared_memory_named,
    shared_memory_of,
};
use crate::waiting::POLL;
pub use crate::waiting::{PATIENCE, until};

/// Returns the `dmprl` next to this test's executable; cargo builds it with the workspace's tests.
///
/// # Panics
/// If it is missing, or older than its sources: `cargo test -p dmprl-tests` does not build it.
pub fn executable() -> &'static Path {
    static EXECUTABLE: OnceLock<PathBuf> = OnceLock::new();
    EXECUTABLE.get_or_init(|| {
        let test = std::env::current_exe().expect("a test knows its executable");
        let folder = test.parent().and_then(Path::parent).expect("target/<profile>/deps/<test>");
        let program = folder.join("dmprl");
        let advice = "build it as these tests were built: cargo test of the whole workspace, or \
                      cargo build --bin dmprl first";
        let built = modified(&program)
            .unwrap_or_else(|| panic!("there is no {}; {advice}", program.display()));
        // Cargo's list of the program's sources, by which it decides on a rebuild too.
        let listed = fs::read_to_string(folder.join("dmprl.d")).unwrap_or_default();
        let sources = listed.split_once(": ").map_or("", |(_, sources)| sources);
        for source in sources.split_whitespace().map(Path::new) {
            assert!(
                modified(source).is_none_or(|changed| changed <= built),
                "{} is older than {}; {advice}",
                program.display(),
                source.display()
            );
        }
        program
    })
}

fn modified(path: &Path) -> Option<SystemTime> {
    fs::metadata(path).and_then(|metadata| metadata.modified()).ok()
}

/// A folder with a short path for the runs of a test. Dropping it kills every process that names
/// it, and removes it.
#[derive(Debug)]
pub struct Workplace {
    folder: TempDir,
}

impl Workplace {
    /// Makes an empty folder. Also makes the Python environment, so that no deadline includes this.
    ///
    /// # Panics
    /// If it cannot be made.
    #[cfg(feature = "python")]
    #[expect(clippy::new_without_default, reason = "it makes a folder and .venv")]
    pub fn new() -> Self {
        crate::venv();
        let folder = tempfile::Builder::new().prefix("dmprl-").tempdir();
        Self { folder: folder.expect("a temporary folder") }
    }

    /// Returns the folder.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Returns a path in the folder, as text for a command line.
    ///
    /// # Panics
    /// If the path is not UTF-8.
    pub fn path(&self, name: &str) -> String {
        self.folder().join(name).into_os_string().into_string().expect("UTF-8")
    }

    /// Starts `dmprl` in this folder, in its own process group as a shell does.
    ///
    /// # Panics
    /// If it cannot be started.
    pub fn start(&self, arguments: &[impl AsRef<OsStr>]) -> Running {
        let mut command = Command::new(executable());
        command.args(arguments);
        self.start_command(command)
    }

    /// Starts a command that the test has changed; otherwise as [`Workplace::start`].
    ///
    /// # Panics
    /// If it cannot be started.
    pub fn start_command(&self, mut command: Command) -> Running {
        let output = tempfile::tempdir_in(self.folder()).expect("a folder for output");
        let file = |name| File::create(output.path().join(name)).expect("a file for output");
        for (name, _) in std::env::vars_os() {
            if name.to_string_lossy().starts_with("DMPRL_") {
                command.env_remove(name);
            }
        }
        // The user's own state directory stays as it is.
        if !command.get_envs().any(|(name, _)| name == "XDG_STATE_HOME") {
            command.env("XDG_STATE_HOME", state_folder());
        }
        command.current_dir(self.folder());
        // A new session, not only a group: when the leader of a group in our session is killed, the
        // kernel wakes the group's stopped members with SIGHUP and SIGCONT, so a learner that the
        // test had stopped would run again. SIGHUP has its default effect, also in tests that run
        // under nohup.
        // SAFETY: `setsid` and `signal` are async-signal-safe, allocate nothing and touch no lock.
        unsafe {
            command.pre_exec(|| {
                libc::signal(libc::SIGHUP, libc::SIG_DFL);
                rustix::process::setsid().map(drop).map_err(Into::into)
            });
        }
        command.stdin(Stdio::null()).stdout(file("out")).stderr(file("err"));
        let child = command.spawn().expect("dmprl starts");
        let id = i32::try_from(child.id()).ok().and_then(Pid::from_raw).expect("a process id");
        Running { child, id, output, started: Instant::now(), line: format!("{command:?}") }
    }

    /// Runs `dmprl` to its end.
    ///
    /// # Panics
    /// If it does not end within [`PATIENCE`].
    pub fn run(&self, arguments: &[impl AsRef<OsStr>]) -> Finished {
        self.start(arguments).wait()
    }

    /// Returns the processes that name this folder on their command line.
    pub fn processes(&self) -> Vec<Process> {
        processes_naming(&self.path(""))
    }

    /// Returns the first process with this role.
    ///
    /// # Panics
    /// If there is none.
    pub fn process(&self, role: &str) -> Process {
        process_naming(&self.path(""), role)
    }

    /// Waits until no process names this folder and ended processes have released their locks.
    ///
    /// # Panics
    /// If that takes longer than [`PATIENCE`].
    pub fn until_no_process(&self) {
        until("no process of the workplace", || self.processes().is_empty() && !any_is_dying());
    }

    /// Fails if a process names this folder.
    ///
    /// # Panics
    /// If there is one.
    pub fn assert_no_process(&self) {
        let processes = self.processes();
        assert!(processes.is_empty(), "left running: {processes:#?}");
    }
}

impl Drop for Workplace {
    fn drop(&mut self) {
        for process in self.processes() {
            process.signal(Signal::KILL);
        }
    }
}

/// Folder for the state of the user who runs the tests, beside the test executables.
fn state_folder() -> PathBuf {
    let profile = executable().parent().expect("the folder of the executable");
    profile.join("test-state")
}

/// A `dmprl` that was started. Dropping it kills its process group.
#[derive(Debug)]
pub struct Running {
    child: Child,
    id: Pid,
    output: TempDir,
    started: Instant,
    line: String,
}

impl Running {
    /// Returns the id of the process itself, without its children.
    pub fn id(&self) -> Pid {
        self.id
    }

    /// Sends a signal to the process and its children, as a terminal does for Ctrl-C.
    pub fn signal_group(&self, signal: Signal) {
        let _ = kill_process_group(self.id, signal);
    }

    /// Sends a signal to the process only.
    pub fn signal(&self, signal: Signal) {
        let _ = kill_process(self.id, signal);
    }

    /// Returns its standard error so far.
    pub fn said(&self) -> String {
        self.read("err")
    }

    /// Returns its standard output so far.
    pub fn printed(&self) -> String {
        self.read("out")
    }

    /// Waits for a condition.
    ///
    /// # Panics
    /// If the process ends first, or [`PATIENCE`] elapses.
    pub fn until(&mut self, what: &str, mut condition: impl FnMut(&Self) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !condition(self) {
            let ended = self.child.try_wait().expect("a child can be waited for");
            // The last output may fulfil the condition.
            if ended.is_some() && condition(self) {
                return;
            }
            let (line, said) = (&self.line, self.said());
            assert!(ended.is_none(), "{line}\nended before {what}: {ended:?}\n{said}");
            assert!(Instant::now() < deadline, "{line}\nnot within {PATIENCE:?}: {what}\n{said}");
            thread::sleep(POLL);
        }
    }

    /// Waits for words on standard error.
    ///
    /// # Panics
    /// As [`Running::until`].
    pub fn until_said(&mut self, words: &str) {
        self.until(words, |running| running.said().contains(words));
    }

    /// Returns its events so far, with `--events json`.
    ///
    /// # Panics
    /// If a line on standard error is not JSON.
    pub fn events(&self) -> Vec<Value> {
        events(&self.said())
    }

    /// Waits for an event with these keys and values; it may have others.
    ///
    /// # Panics
    /// As [`Running::until`].
    pub fn until_event(&mut self, keys: &Value) {
        self.until(&format!("event {keys}"), |running| has_event(&running.events(), keys));
    }

    /// Waits until `metrics.jsonl` of `run` has reached this number of environment steps.
    ///
    /// # Panics
    /// As [`Running::until`].
    pub fn until_steps(&mut self, run: &str, env_steps: u64) {
        let what = format!("{env_steps} steps");
        self.until(&what, |_| env_steps_of(run).is_some_and(|steps| steps >= env_steps));
    }

    /// Waits for the end.
    ///
    /// # Panics
    /// If it does not end within [`PATIENCE`].
    pub fn wait(mut self) -> Finished {
        let deadline = Instant::now() + PATIENCE;
        let status = loop {
            if let Some(status) = self.child.try_wait().expect("a child can be waited for") {
                break status;
            }
            let (line, said) = (&self.line, self.said());
            assert!(Instant::now() < deadline, "{line}\ndid not end in {PATIENCE:?}\n{said}");
            thread::sleep(POLL);
        };
        Finished {
            status,
            took: self.started.elapsed(),
            printed: self.read("out"),
            said: self.said(),
            line: self.line.clone(),
        }
    }

    fn read(&self, name: &str) -> String {
        let bytes = fs::read(self.output.path().join(name)).unwrap_or_default();
        String::from_utf8_lossy(&bytes).into_owned()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if matches!(self.child.try_wait(), Ok(None)) {
            self.signal_group(Signal::KILL);
            let _ = self.child.wait();
        }
    }
}

/// A `dmprl` that has ended.
#[derive(Debug)]
pub struct Finished {
    /// Exit status.
    pub status: ExitStatus,
    /// Time from start to end.
    pub took: Duration,
    /// Standard output.
    pub printed: String,
    /// Standard error.
    pub said: String,
    line: String,
}

impl Finished {
    /// Checks the exit status; returns itself for further checks.
    ///
    /// # Panics
    /// If the status differs, with the whole output.
    pub fn with_status(self, code: i32) -> Self {
        assert_eq!(
            (self.status.code(), self.status.signal()),
            (Some(code), None),
            "{}\n{}{}",
            self.line,
            self.printed,
            self.said
        );
        self
    }

    /// Checks that standard error contains a text.
    ///
    /// # Panics
    /// If it does not, with the whole output.
    pub fn saying(self, words: &str) -> Self {
        assert!(self.said.contains(words), "{}\ndid not say `{words}`:\n{}", self.line, self.said);
        self
    }

    /// Checks that there is an event with these keys and values, with `--events json`.
    ///
    /// # Panics
    /// If there is none, with the whole output.
    pub fn with_event(self, keys: &Value) -> Self {
        assert!(has_event(&events(&self.said), keys), "{}\n{keys}:\n{}", self.line, self.said);
        self
    }

    /// Returns the JSON object on standard output.
    ///
    /// # Panics
    /// If standard output is not one JSON object.
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.printed)
            .unwrap_or_else(|error| panic!("{}\n{error}: {}", self.line, self.printed))
    }
}

/// Returns the events in the complete lines of standard error.
fn events(said: &str) -> Vec<Value> {
    let whole = said.rfind('\n').map_or("", |end| &said[..end]);
    let parse = |line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
    whole.lines().map(parse).collect()
}

fn has_event(events: &[Value], keys: &Value) -> bool {
    let Value::Object(keys) = keys else { return false };
    events.iter().any(|event| keys.iter().all(|(key, value)| event[key] == *value))
}
