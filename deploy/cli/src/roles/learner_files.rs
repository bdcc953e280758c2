//! Writes the learner's records to the run directory.

use std::fs::File;
use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context;
use dmprl_chaos::journal::{Entry, Journal};
use dmprl_learner::learner::Counters;
use dmprl_learner::recorder::{PreviousSessions, RunFiles};
use dmprl_learner::session::DueError;
use dmprl_run::{RunDirectory, replace_file};

/// Reads from the run's rows where its earlier sessions ended.
pub fn past(run: &RunDirectory) -> anyhow::Result<PreviousSessions> {
    Ok(PreviousSessions {
        wall_s: run.wall_s_before()?,
        measured: run.measured_steps()?,
        evaluated: run.latest_row()?.map(|row| row.env_steps),
    })
}

/// The learner's files in a run directory, and its journal, if any.
pub struct LearnerFiles<'a> {
    run: &'a RunDirectory,
    metrics: File,
    journal: Option<Journal>,
}

impl<'a> LearnerFiles<'a> {
    /// Opens `metrics.jsonl`.
    pub fn open(run: &'a RunDirectory, journal: Option<Journal>) -> anyhow::Result<Self> {
        let path = run.metrics_path();
        let metrics = File::options().append(true).create(true).open(&path);
        let metrics = metrics.with_context(|| format!("cannot open {}", path.display()))?;
        Ok(Self { run, metrics, journal })
    }
}

impl RunFiles for LearnerFiles<'_> {
    fn append_metrics(&mut self, line: &[u8]) -> io::Result<()> {
        let before = self.metrics.metadata().map(|metadata| metadata.len());
        self.metrics.write_all(line).inspect_err(|_| {
            // Remove a partial line, which would corrupt the next one.
            let _ = before.and_then(|len| self.metrics.set_len(len));
        })
    }

    fn save_policy(&mut self, version: u64, bytes: &[u8]) -> Result<(), DueError> {
        Ok(replace_file(&self.run.policy_path(version), bytes)?)
    }

    fn checkpoints(&self) -> PathBuf {
        self.run.checkpoints_path()
    }

    fn checkpoint_begins(&mut self, counters: &Counters) {
        if let Some(journal) = &self.journal {
            journal.note(Entry::CheckpointBegun(counters.into()));
        }
    }
}
