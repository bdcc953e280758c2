//! `processes.json`: which processes a run has, and what they do. The supervisor replaces it while
//! it trains; whoever watches reads it.

use anyhow::Context;
use dmprl_shared::supervision::Activity;
use serde::{Deserialize, Serialize};

use crate::atomic;
use crate::directory::{RunDirectory, read_small};

/// Of this file; raised when what it holds changes.
const FORMAT: u32 = 1;

/// The processes of a run's last session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Processes {
    format: u32,
    /// Whether the session has come to its end; if not, and nobody trains, it was killed.
    pub ended: bool,
    /// How old the session was when this was written \[s\].
    pub session_s: f64,
    /// Learner, workers, evaluator.
    pub processes: Vec<ProcessRow>,
}

/// One of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProcessRow {
    /// `learner`, `actor-0`, `evaluator`.
    pub name: String,
    /// Whether somebody else has started it: a worker that has joined.
    pub joined: bool,
    /// Where it is in its life.
    pub state: ProcessState,
    /// What a worker did when it last gave a sign of life.
    pub doing: Option<Activity>,
    /// Segments that a worker keeps until the learner acknowledges them.
    pub kept_segments: u64,
    /// Segments of a worker that the learner has acknowledged in this session.
    pub acknowledged_segments: u64,
    /// Starts in this session.
    pub starts: u32,
    /// Seconds since the last start; none when it does not run.
    pub up_s: Option<f64>,
    /// Seconds since it last said anything.
    pub silent_s: Option<f64>,
    /// Processor time since its start \[s\].
    pub cpu_s: Option<f64>,
    /// Memory that it occupies, what it shares included.
    pub memory_bytes: Option<u64>,
}

/// Where a process is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProcessState {
    /// It makes its environments or reads its checkpoint.
    Starting,
    /// It does its work.
    Running,
    /// It has died, and will be started again.
    Restarting,
    /// It is not there, and will not be.
    Gone,
}

impl Processes {
    /// What a session has now.
    #[must_use]
    pub fn new(ended: bool, session_s: f64, processes: Vec<ProcessRow>) -> Self {
        Self { format: FORMAT, ended, session_s, processes }
    }
}

impl RunDirectory {
    /// Replaces `processes.json`. Not synced: it is about this moment only, and nothing may wait
    /// for a disk.
    ///
    /// # Errors
    /// What the file system refuses.
    pub fn write_processes(&self, processes: &Processes) -> anyhow::Result<()> {
        let text = serde_json::to_vec(processes).context("cannot write processes.json")?;
        atomic::replace_unsynced(&self.path().join("processes.json"), &text)
    }

    /// What the supervisor wrote last; none by a version that did not, or of another format.
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
