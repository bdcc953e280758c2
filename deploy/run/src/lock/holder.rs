//! The process that holds a run's lock: where it runs, and whether it is alive.

use std::fmt::{self, Display, Formatter};
use std::fs;

use serde::{Deserialize, Serialize};

use crate::words_after_program;

/// A process that holds, or last held, the lock of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Holder {
    /// Process id, in the process's own namespace.
    pub pid: u32,
    /// Where it runs; `None` in the lock of an older program, which stored only the id.
    pub(super) origin: Option<Origin>,
}

/// Where and when a process was started.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Origin {
    /// Host name, for messages; several hosts may have the same.
    pub host: String,
    /// Identifies the running kernel; empty if the kernel does not report it.
    pub boot_id: String,
    /// Namespace of the process id, which differs between the containers of a host.
    pub pid_namespace: String,
    /// Start of the process \[clock ticks since boot\]: process ids are reused.
    pub started_ticks: u64,
}

impl Holder {
    /// Describes this process.
    pub(super) fn this() -> Self {
        let pid = std::process::id();
        let boot_id = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
        let pid_namespace = fs::read_link("/proc/self/ns/pid").unwrap_or_default();
        let origin = Origin {
            host: rustix::system::uname().nodename().to_string_lossy().into_owned(),
            boot_id: boot_id.trim().to_owned(),
            pid_namespace: pid_namespace.display().to_string(),
            started_ticks: started_ticks(pid).unwrap_or_default(),
        };
        Self { pid, origin: Some(origin) }
    }

    /// Parses a lock file: the process id, then a line of JSON, which older programs do not write.
    pub(super) fn parse(text: &str) -> Option<Self> {
        let mut lines = text.lines();
        let pid = lines.next()?.trim().parse().ok()?;
        let holder = lines.next().and_then(|line| serde_json::from_str(line).ok());
        Some(holder.unwrap_or(Self { pid, origin: None }))
    }

    /// Returns true if the process runs or ran under this kernel, in this namespace of process
    /// ids; false also if that is unknown.
    #[must_use]
    pub fn is_on_this_machine(&self) -> bool {
        self.is_beside(&Self::this())
    }

    /// Returns true if both processes are known to have the same kernel and namespace.
    pub(super) fn is_beside(&self, other: &Self) -> bool {
        let (Some(own), Some(other)) = (&self.origin, &other.origin) else { return false };
        let known = !own.boot_id.is_empty() && !own.pid_namespace.is_empty();
        known && own.boot_id == other.boot_id && own.pid_namespace == other.pid_namespace
    }

    /// Returns true if this is a supervisor that is alive on this machine. An older program's may
    /// be another one with the same process id. Reads `/proc` instead of trying the lock, because
    /// even a short hold of the lock could make a concurrent resume fail.
    pub(crate) fn is_trainer_here(&self) -> bool {
        let here = self.origin.is_none() || self.is_on_this_machine();
        let words = words_after_program(&command_line(self.pid));
        let command = words.first().map_or("", String::as_str);
        here && self.is_running() && ["train", "resume", "chaos"].contains(&command)
    }

    /// Returns true if a process of this machine with this id, and this start if it is known, is
    /// alive. A zombie has no command line.
    pub(super) fn is_running(&self) -> bool {
        let started = self.origin.as_ref().map(|origin| origin.started_ticks);
        started.is_none_or(|started| started_ticks(self.pid) == Some(started))
            && !command_line(self.pid).is_empty()
    }

    /// Returns true if an older program, other than this process, holds the lock and is alive.
    pub(super) fn is_older_and_running(&self) -> bool {
        self.origin.is_none() && self.pid != std::process::id() && self.is_running()
    }
}

impl Display for Holder {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        write!(formatter, "process {}", self.pid)?;
        match &self.origin {
            Some(origin) => write!(formatter, " on host {}", origin.host),
            None => Ok(()),
        }
    }
}

fn command_line(pid: u32) -> Vec<u8> {
    fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default()
}

/// Start of a process; `None` if it has ended.
fn started_ticks(pid: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // Field 22; field 2 is the name, which may contain spaces and parentheses.
    let (_, after_name) = stat.rsplit_once(')')?;
    after_name.split_whitespace().nth(19)?.parse().ok()
}
