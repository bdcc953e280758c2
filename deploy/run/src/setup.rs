//! Reads the files of a run directory that every process of a run needs.

use std::path::Path;

use anyhow::Context;
use dmprl_shared::config::ExperimentConfig;

use crate::RunDirectory;

/// A run directory with its configuration and id.
pub struct Setup {
    /// The run directory.
    pub run: RunDirectory,
    /// Resolved configuration of the run.
    pub config: ExperimentConfig,
    /// Id of the run, which every segment contains.
    pub run_id: u64,
}

impl Setup {
    /// Reads a run directory.
    ///
    /// # Errors
    /// The directory, its configuration or its manifest cannot be read.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let run = RunDirectory::open(path)?;
        let config = run.config()?;
        let run_id = run.manifest()?.run_id().context("manifest.json")?;
        Ok(Self { run, config, run_id })
    }
}
