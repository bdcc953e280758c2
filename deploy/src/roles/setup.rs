//! Reads the files of the run directory that every role needs.

use anyhow::Context;
use dmprl_shared::config::ExperimentConfig;

use crate::run_directory::RunDirectory;

/// A run directory with its configuration and id.
pub struct Setup {
    pub run: RunDirectory,
    pub config: ExperimentConfig,
    pub run_id: u64,
}

impl Setup {
    pub fn read(path: &std::path::Path) -> anyhow::Result<Self> {
        let run = RunDirectory::open(path)?;
        let config = run.config()?;
        let run_id = run.manifest()?.run_id().context("manifest.json")?;
        Ok(Self { run, config, run_id })
    }
}
