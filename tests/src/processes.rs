//! Processes of this machine, as /proc lists them.

use std::fs;
use std::path::{Path, PathBuf};

use rustix::process::{Pid, Signal, kill_process};

use crate::waiting::until;

/// A process found in /proc.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Process {
    /// Process id.
    pub id: Pid,
    /// Subcommand: `train`, `learner`, `actor`, …
    pub role: String,
    /// Whole command line.
    pub command_line: Vec<String>,
}

impl Process {
    /// Sends a signal; ignores a process that has ended. After `STOP`, waits until no thread runs,
    /// because a thread first ends its system call, such as the renaming of a checkpoint.
    ///
    /// # Panics
    /// If a thread still runs after [`PATIENCE`](crate::waiting::PATIENCE).
    pub fn signal(&self, signal: Signal) {
        let _ = kill_process(self.id, signal);
        if signal == Signal::STOP {
            let threads = PathBuf::from(format!("/proc/{}/task", self.id.as_raw_nonzero()));
            until(&format!("all threads of {self:?} stopped"), || {
                let mut states =
                    numbered(&threads).into_iter().filter_map(|path| thread_state(&path));
                states.all(|(_, state, _)| state == 'T' || is_gone(state))
            });
        }
    }

    /// Returns the processor time of all threads, user and system [clock ticks].
    pub fn cpu_ticks(&self) -> Option<u64> {
        let id = self.id.as_raw_nonzero();
        let stat = fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
        // The name in parentheses may contain anything; utime and stime are fields 14 and 15.
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        Some(fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?)
    }
}

/// Returns true if a `dmprl` has lost its command line but not all of its files: one of its threads
/// is exiting.
pub(crate) fn any_is_dying() -> bool {
    numbered(Path::new("/proc")).into_iter().any(|process| {
        let Some((name, state, _)) = thread_state(&process) else { return false };
        let threads = numbered(&process.join("task"));
        name.contains("dmprl")
            && threads
                .iter()
                .filter_map(|thread| thread_state(thread))
                .any(|(_, own, exiting)| !is_gone(own) && (exiting || is_gone(state)))
    })
}

/// Returns the entries of a folder whose names are numbers, such as processes or threads.
fn numbered(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .filter(|entry| entry.file_name().as_encoded_bytes().iter().all(u8::is_ascii_digit))
        .map(|entry| entry.path())
        .collect()
}

fn is_gone(state: char) -> bool {
    matches!(state, 'Z' | 'X')
}

/// Name, state and exit flag of a thread, or of a process's main thread.
fn thread_state(path: &Path) -> Option<(String, char, bool)> {
    /// `PF_EXITING` of the kernel's `flags`, field 9 of /proc/PID/stat.
    const EXITING: u64 = 0x4;
    let stat = fs::read_to_string(path.join("stat")).ok()?;
    let (name, rest) = stat.rsplit_once(')')?;
    let fields: Vec<&str> = rest.split_whitespace().collect();
    let flags = fields.get(6)?.parse::<u64>().ok()?;
    Some((name.to_owned(), fields.first()?.chars().next()?, flags & EXITING != 0))
}

/// Returns the processes with `text` on their command line. Zombies have no command line.
pub fn processes_naming(text: &str) -> Vec<Process> {
    let Ok(entries) = fs::read_dir("/proc") else { return Vec::new() };
    let mut processes = Vec::new();
    for entry in entries.flatten() {
        let id = entry.file_name().to_str().and_then(|name| name.parse().ok());
        let Some(id) = id.and_then(Pid::from_raw) else { continue };
        // A process that ends after the listing has no command line either.
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

/// Returns the first process with this role among [`processes_naming`] a text.
///
/// # Panics
/// If there is none.
pub fn process_naming(text: &str, role: &str) -> Process {
    let mut processes = processes_naming(text);
    let found = processes.iter().position(|process| process.role == role);
    processes.swap_remove(found.unwrap_or_else(|| panic!("no {role} in {processes:#?}")))
}
