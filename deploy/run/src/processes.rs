//! `processes.json`: the processes of a run and their states. The supervisor replaces it during
//! training, and the dashboard reads it.

use anyhow::Context;
use dmprl_shared::supervision::Activity;
use serde::{Deserialize, Serialize};

use crate::atomic;
use crate::directory::{RunDirectory, read_small};

/// Version of the file's format.
const FORMAT: u32 = 1;

/// The processes of a run's last session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Processes {
    format: u32,
    /// True if the session has ended. If false and no process is training, it was killed.
    pub ended: bool,
    /// Age of the session when the file was written \[s\].
    pub session_s: f64,
    /// Learner, workers, evaluator.
    pub processes: Vec<ProcessRow>,
}

/// State of one process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProcessRow {
    /// `learner`, `actor-0`, `evaluator`.
    pub name: String,
    /// True for a worker that joined the run, and was not started by the supervisor.
    pub joined: bool,
    /// State of the process.
    pub state: ProcessState,
    /// Activity of a worker at its last heartbeat.
    pub doing: Option<Activity>,
    /// Segments that a worker keeps until the learner acknowledges them.
    pub kept_segments: u64,
    /// Segments of a worker that the learner has acknowledged in this session.
    pub acknowledged_segments: u64,
    /// Number of starts in this session.
    pub starts: u32,
    /// Time since the last start \[s\]; `None` if it is not running.
    pub up_s: Option<f64>,
    /// Time since its last message \[s\].
    pub silent_s: Option<f64>,
    /// Processor time since its start \[s\].
    pub cpu_s: Option<f64>,
    /// Resident memory, including shared pages.
    pub memory_bytes: Option<u64>,
}

/// State of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProcessState {
    /// It is creating its environments or reading its checkpoint.
    Starting,
    /// It is working.
    Running,
    /// It has died and will be restarted.
    Restarting,
    /// It has ended and will not be restarted.
    Gone,
}

impl Processes {
    /// Creates the content of the file.
    #[must_use]
    pub fn new(ended: bool, session_s: f64, processes: Vec<ProcessRow>) -> Self {
        Self { format: FORMAT, ended, session_s, processes }
    }
}

impl RunDirectory {
    /// Replaces `processes.json`. The file is not synced: it describes only the current state, and
    /// the supervisor must not wait for a disk.
    ///
    /// # Errors
    /// An I/O error.
    pub fn write_processes(&self, processes: &Processes) -> anyhow::Result<()> {
        let text = serde_json::to_vec(processes).context("cannot write processes.json")?;
        atomic::replace_unsynced(&self.path().join("processes.json"), &text)
    }

    /// Reads the file; `None` if it does not exist or has another format.
    ///
    /// # Errors
    /// The file cannot be read, or is damaged.
    pub fn processes(&self) -> anyhow::Result<Option<Processes>> {
        let path = self.path().join("processes.json");
        if !path.exists() {
            return Ok(None);
        }
        let processes: Processes = serde_json::from_str(&read_small(&path)?)
            .with_context(|| format!("{} is damaged", path.display()))?;
        Ok((processes.format == FORMAT).then_some(processes))
    }
}
