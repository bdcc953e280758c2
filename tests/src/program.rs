//! The program as a user runs it: real processes with a deadline, and what they leave behind.
//!
//! The one place that finds the executable, starts it, signals it, waits for it, and looks for
//! processes and shared memory that should be gone.

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

pub use crate::run_files::{
    env_steps, env_steps_of, env_steps_of_checkpoint, json_file, rows, shared_memory_named,
    shared_memory_of,
};

/// No test waits longer for anything: far beyond what a loaded machine needs.
pub const PATIENCE: Duration = Duration::from_secs(120);
/// Between two looks at a condition.
const POLL: Duration = Duration::from_millis(10);

/// The `dmprl` beside this test's executable; cargo builds it with the workspace's tests.
///
/// # Panics
/// When it is missing or older than its sources: `cargo test -p dmprl-tests` does not build it.
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
        // Cargo's own list of what the program was made from: the same rule as a rebuild.
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

/// Looks at a condition until it holds.
///
/// # Panics
/// When it does not within [`PATIENCE`].
pub fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < deadline, "waited {PATIENCE:?} in vain for: {what}");
        thread::sleep(POLL);
    }
}

/// A folder with a short path for a test's runs. Dropped, it is gone with every process that still
/// names it.
#[derive(Debug)]
pub struct Workplace {
    folder: TempDir,
}

impl Workplace {
    /// An empty one; the Python environment is there, so that no deadline includes its making.
    ///
    /// # Panics
    /// When it cannot be made.
    #[cfg(feature = "python")]
    #[expect(clippy::new_without_default, reason = "it makes a folder and .venv")]
    pub fn new() -> Self {
        crate::venv();
        let folder = tempfile::Builder::new().prefix("dmprl-").tempdir();
        Self { folder: folder.expect("a temporary folder") }
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// A path in it, as text for a command line.
    ///
    /// # Panics
    /// When the path is no UTF-8.
    pub fn path(&self, name: &str) -> String {
        self.folder().join(name).into_os_string().into_string().expect("UTF-8")
    }

    /// Starts `dmprl` in this folder, in a process group of its own as a shell does.
    ///
    /// # Panics
    /// When it cannot be started.
    pub fn start(&self, arguments: &[impl AsRef<OsStr>]) -> Running {
        let mut command = Command::new(executable());
        command.args(arguments);
        self.start_command(command)
    }

    /// As [`Workplace::start`], for a command that the test has changed.
    ///
    /// # Panics
    /// When it cannot be started.
    pub fn start_command(&self, mut command: Command) -> Running {
        let output = tempfile::tempdir_in(self.folder()).expect("a folder for output");
        let file = |name| File::create(output.path().join(name)).expect("a file for output");
        for (name, _) in std::env::vars_os() {
            if name.to_string_lossy().starts_with("DMPRL_") {
                command.env_remove(name);
            }
        }
        command.current_dir(self.folder());
        // A session of its own, not only a group: when the leader of a group in our session is
        // killed, the kernel wakes the group's stopped members with SIGHUP and SIGCONT, and a test
        // that had stopped the learner found it running.
        // SAFETY: `setsid` is async-signal-safe, allocates nothing and touches no lock.
        unsafe {
            command.pre_exec(|| rustix::process::setsid().map(drop).map_err(Into::into));
        }
        command.stdin(Stdio::null()).stdout(file("out")).stderr(file("err"));
        let child = command.spawn().expect("dmprl starts");
        let id = i32::try_from(child.id()).ok().and_then(Pid::from_raw).expect("a process id");
        Running { child, id, output, started: Instant::now(), line: format!("{command:?}") }
    }

    /// Runs `dmprl` to its end.
    ///
    /// # Panics
    /// When it does not end within [`PATIENCE`].
    pub fn run(&self, arguments: &[impl AsRef<OsStr>]) -> Finished {
        self.start(arguments).wait()
    }

    /// The processes that name this folder on their command line.
    pub fn processes(&self) -> Vec<Process> {
        processes_naming(&self.path(""))
    }

    /// Waits until no process names this folder and what has died has let go of its locks.
    ///
    /// # Panics
    /// When that takes longer than [`PATIENCE`].
    pub fn until_no_process(&self) {
        until("no process of the workplace", || self.processes().is_empty() && !any_is_dying());
    }

    /// Refuses a process that names this folder.
    ///
    /// # Panics
    /// When there is one.
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

/// A process found in /proc.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Process {
    /// Its id.
    pub id: Pid,
    /// The subcommand: `train`, `learner`, `actor`, …
    pub role: String,
    /// Everything on its command line.
    pub command_line: Vec<String>,
}

impl Process {
    /// Sends a signal; a process that is gone already has no use for it.
    pub fn signal(&self, signal: Signal) {
        let _ = kill_process(self.id, signal);
    }

    /// Processor time used so far, all threads, user and system together [clock ticks].
    pub fn cpu_ticks(&self) -> Option<u64> {
        let id = self.id.as_raw_nonzero();
        let stat = fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
        // The name in parentheses may hold anything; utime and stime are fields 14 and 15.
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        Some(fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?)
    }
}

/// Whether any `dmprl` has lost its command line, but not all of its files: a thread of it is on
/// its way out, or will be when it next runs.
fn any_is_dying() -> bool {
    let ids = |path: &Path| {
        let entries = fs::read_dir(path).into_iter().flatten().flatten();
        entries
            .filter(|entry| entry.file_name().as_encoded_bytes().iter().all(u8::is_ascii_digit))
            .map(|entry| entry.path())
            .collect::<Vec<_>>()
    };
    ids(Path::new("/proc")).into_iter().any(|process| {
        let Some((name, state, _)) = thread_state(&process) else { return false };
        let threads = ids(&process.join("task"));
        name.contains("dmprl")
            && threads
                .iter()
                .filter_map(|thread| thread_state(thread))
                .any(|(_, own, exiting)| !is_gone(own) && (exiting || is_gone(state)))
    })
}

fn is_gone(state: char) -> bool {
    matches!(state, 'Z' | 'X')
}

/// Name, state and whether it is exiting, of a thread or of a process's first one.
fn thread_state(path: &Path) -> Option<(String, char, bool)> {
    /// `PF_EXITING` of the kernel's `flags`, field 9 of /proc/PID/stat.
    const EXITING: u64 = 0x4;
    let stat = fs::read_to_string(path.join("stat")).ok()?;
    let (name, rest) = stat.rsplit_once(')')?;
    let fields: Vec<&str> = rest.split_whitespace().collect();
    let flags = fields.get(6)?.parse::<u64>().ok()?;
    Some((name.to_owned(), fields.first()?.chars().next()?, flags & EXITING != 0))
}

/// The processes that have `text` on their command line. Zombies have no command line.
pub fn processes_naming(text: &str) -> Vec<Process> {
    let Ok(entries) = fs::read_dir("/proc") else { return Vec::new() };
    let mut processes = Vec::new();
    for entry in entries.flatten() {
        let id = entry.file_name().to_str().and_then(|name| name.parse().ok());
        let Some(id) = id.and_then(Pid::from_raw) else { continue };
        // One that ends between the listing and the look has no command line either.
        let line = fs::read(entry.path().join("cmdline")).unwrap_or_default();
        let line = String::from_utf8_lossy(&line).into_owned();
        if line.contains(text) {
            let command_line: Vec<String> =
                line.trim_end_matches('\0').split('\0').map(str::to_owned).collect();
            let role = command_line.get(1).cloned().unwrap_or_default();
            processes.push(Process { id, role, command_line });
        }
    }
    processes
}

/// A `dmprl` that was started. Dropped, its whole process group is killed.
#[derive(Debug)]
pub struct Running {
    child: Child,
    id: Pid,
    output: TempDir,
    started: Instant,
    line: String,
}

impl Running {
    /// The process itself, without its children.
    pub fn id(&self) -> Pid {
        self.id
    }

    /// A signal to the process and all its children, as a terminal sends Ctrl-C.
    pub fn signal_group(&self, signal: Signal) {
        let _ = kill_process_group(self.id, signal);
    }

    /// A signal to the process alone.
    pub fn signal(&self, signal: Signal) {
        let _ = kill_process(self.id, signal);
    }

    /// What it has written to standard error so far.
    pub fn said(&self) -> String {
        self.read("err")
    }

    /// What it has written to standard output so far.
    pub fn printed(&self) -> String {
        self.read("out")
    }

    /// Waits for a condition.
    ///
    /// # Panics
    /// When the process ends before, or neither happens within [`PATIENCE`].
    pub fn until(&mut self, what: &str, mut condition: impl FnMut(&Self) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !condition(self) {
            let ended = self.child.try_wait().expect("a child can be waited for");
            // What it waits for may have come with the end.
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

    /// Its events so far, with `--events json`.
    ///
    /// # Panics
    /// When a line on standard error is no JSON.
    pub fn events(&self) -> Vec<Value> {
        events(&self.said())
    }

    /// Waits for an event that has these keys and values, among others.
    ///
    /// # Panics
    /// As [`Running::until`].
    pub fn until_event(&mut self, keys: &Value) {
        self.until(&format!("event {keys}"), |running| has_event(&running.events(), keys));
    }

    /// Waits until `metrics.jsonl` of `run` tells of so many environment steps.
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
    /// When it does not end within [`PATIENCE`].
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
    /// How.
    pub status: ExitStatus,
    /// From start to end.
    pub took: Duration,
    /// Standard output.
    pub printed: String,
    /// Standard error.
    pub said: String,
    line: String,
}

impl Finished {
    /// Insists on an exit status; returns itself to look further.
    ///
    /// # Panics
    /// With all it has said, when it is another.
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

    /// Insists on words on standard error.
    ///
    /// # Panics
    /// With all it has said, when they are not there.
    pub fn saying(self, words: &str) -> Self {
        assert!(self.said.contains(words), "{}\ndid not say `{words}`:\n{}", self.line, self.said);
        self
    }

    /// Insists on an event that has these keys and values, among others, with `--events json`.
    ///
    /// # Panics
    /// With all it has said, when there is none.
    pub fn with_event(self, keys: &Value) -> Self {
        assert!(has_event(&events(&self.said), keys), "{}\n{keys}:\n{}", self.line, self.said);
        self
    }

    /// The JSON object on standard output.
    ///
    /// # Panics
    /// When there is another thing.
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.printed)
            .unwrap_or_else(|error| panic!("{}\n{error}: {}", self.line, self.printed))
    }
}

/// The events in whole lines of standard error.
fn events(said: &str) -> Vec<Value> {
    let whole = said.rfind('\n').map_or("", |end| &said[..end]);
    let parse = |line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
    whole.lines().map(parse).collect()
}

fn has_event(events: &[Value], keys: &Value) -> bool {
    let Value::Object(keys) = keys else { return false };
    events.iter().any(|event| keys.iter().all(|(key, value)| event[key] == *value))
}
