//! Writes the input of `envs_py/dmprl/rerun_log.py`, as one JSON object.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use anyhow::Context;
use serde::Serialize;

use super::video::SideRecord;

#[derive(Debug, Serialize)]
struct RerunPlan<'a> {
    sides: Vec<Side<'a>>,
    output: &'a Path,
}

#[derive(Debug, Serialize)]
struct Side<'a> {
    /// Name of the run directory.
    name: Cow<'a, str>,
    title: &'a str,
    /// The observer's file.
    episodes: &'a Path,
}

/// Writes the plan into `folder`; returns its path.
///
/// - `output`: path of the log that `rerun_log.py` will write.
pub(super) fn write<'a>(
    sides: &'a [SideRecord],
    output: &'a Path,
    folder: &Path,
) -> anyhow::Result<PathBuf> {
    let side = |side: &'a SideRecord| Side {
        name: side.run.file_name().unwrap_or_default().to_string_lossy(),
        title: &side.title,
        episodes: &side.observed,
    };
    let plan = RerunPlan { sides: sides.iter().map(side).collect(), output };
    let path = folder.join("rerun-plan.json");
    let text = serde_json::to_vec(&plan).context("cannot serialize the plan of the Rerun log")?;
    std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(path)
}
