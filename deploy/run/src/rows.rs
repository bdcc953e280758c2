//! `evaluations.jsonl` and `metrics.jsonl`: JSON lines. A crash can cut only the last one short.

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::Path;

use anyhow::{Context, ensure};
use dmprl_shared::supervision::EvaluationRow;
use serde::Deserialize;
use serde::de::DeserializeOwned;

use crate::atomic;
use crate::directory::RunDirectory;

/// Maximum length of a line. A file with a longer one is damaged.
const LINE_BYTES_MAX: u64 = 64 << 20;
/// Number of bytes at the end of a file in which to look for its last complete line.
const TAIL_BYTES: u64 = 1 << 20;

impl RunDirectory {
    /// Appends a row and syncs it. First removes a partial line that a crash left behind.
    ///
    /// # Errors
    /// A number of the row is not finite, which JSON cannot represent, or an I/O error.
    pub fn append_evaluation(&self, row: &EvaluationRow) -> anyhow::Result<()> {
        row.check_finite()?;
        let path = self.evaluations_path();
        let mut line = serde_json::to_vec(row).context("cannot write an evaluation as JSON")?;
        line.push(b'\n');
        append(&path, &line).with_context(|| format!("cannot append to {}", path.display()))
    }

    /// Reads all complete rows, oldest first.
    ///
    /// # Errors
    /// A complete line is invalid, because another program changed the file, or an I/O error.
    pub fn evaluations(&self) -> anyhow::Result<Vec<EvaluationRow>> {
        let path = self.evaluations_path();
        let mut rows = Vec::new();
        for_each_line(&path, |index, line| {
            rows.push(serde_json::from_slice(line).with_context(|| {
                format!("{}, line {}: invalid evaluation", path.display(), index + 1)
            })?);
            Ok(())
        })?;
        Ok(rows)
    }

    /// Returns the best row whose policy is saved ([`EvaluationRow::compare`]), the latest of
    /// equals. If no policy is saved, returns the best row of all.
    ///
    /// # Errors
    /// As [`RunDirectory::evaluations`].
    pub fn best_row(&self) -> anyhow::Result<Option<EvaluationRow>> {
        let saved = self.saved_policies()?;
        let is_saved = |row: &EvaluationRow| saved.contains(&row.policy_version);
        let better = |a: &EvaluationRow, b: &EvaluationRow| {
            is_saved(a).cmp(&is_saved(b)).then_with(|| a.compare(b))
        };
        Ok(self.evaluations()?.into_iter().max_by(better))
    }

    /// Returns the last row.
    ///
    /// # Errors
    /// As [`RunDirectory::evaluations`].
    pub fn latest_row(&self) -> anyhow::Result<Option<EvaluationRow>> {
        Ok(self.evaluations()?.pop())
    }

    /// Removes the metrics and evaluations after `env_steps`, the steps of the checkpoint from
    /// which the run resumes. The other lines are not changed.
    ///
    /// # Errors
    /// A complete line has no `env_steps`, or an I/O error.
    pub fn rewind(&self, env_steps: u64) -> anyhow::Result<()> {
        #[derive(Deserialize)]
        struct Row {
            env_steps: u64,
        }
        for path in [self.metrics_path(), self.evaluations_path()] {
            let mut kept = Vec::new();
            for_each_line(&path, |index, line| {
                let row: Row = serde_json::from_slice(line).with_context(|| {
                    format!("{}, line {}: no env_steps", path.display(), index + 1)
                })?;
                if row.env_steps <= env_steps {
                    kept.extend_from_slice(line);
                    kept.push(b'\n');
                }
                Ok(())
            })?;
            atomic::replace(&path, &kept)?;
        }
        Ok(())
    }

    /// Removes all metrics, evaluations and saved policies, so that the run can start again.
    ///
    /// # Errors
    /// An I/O error.
    pub fn begin_again(&self) -> anyhow::Result<()> {
        for path in [self.metrics_path(), self.evaluations_path()] {
            atomic::replace(&path, b"")?;
        }
        for version in self.saved_policies()? {
            let path = self.policy_path(version);
            std::fs::remove_file(&path)
                .with_context(|| format!("cannot remove {}", path.display()))?;
        }
        // This link points to one of the policies.
        let best = self.checkpoints_path().join("best");
        match std::fs::remove_file(&best) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(error).with_context(|| format!("cannot remove {}", best.display()))
            }
            _ => Ok(()),
        }
    }

    /// Returns the training time of all sessions so far \[s\], according to the last rows.
    ///
    /// # Errors
    /// The rows cannot be read.
    pub fn wall_s_before(&self) -> anyhow::Result<f64> {
        #[derive(Deserialize)]
        struct Row {
            #[serde(default)]
            wall_s: f64,
        }
        let mut latest = 0.0_f64;
        for path in [self.metrics_path(), self.evaluations_path()] {
            if let Some(row) = last_row::<Row>(&path)? {
                latest = latest.max(row.wall_s);
            }
        }
        Ok(latest)
    }

    /// Reads the last line of `metrics.jsonl`.
    ///
    /// # Errors
    /// The line cannot be read.
    pub fn last_metrics(&self) -> anyhow::Result<Option<serde_json::Value>> {
        last_row(&self.metrics_path())
    }

    /// Reads the environment steps in the last line of `metrics.jsonl`.
    ///
    /// # Errors
    /// The line cannot be read.
    pub fn measured_steps(&self) -> anyhow::Result<Option<u64>> {
        #[derive(Deserialize)]
        struct Row {
            env_steps: u64,
        }
        Ok(last_row::<Row>(&self.metrics_path())?.map(|row| row.env_steps))
    }
}

fn append(path: &Path, line: &[u8]) -> std::io::Result<()> {
    let mut file =
        OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
    let whole = whole_len(&mut file)?;
    file.set_len(whole)?;
    file.seek(SeekFrom::Start(whole))?;
    file.write_all(line)?;
    file.sync_data()
}

/// Returns the length of the file up to and including its last line end.
fn whole_len(file: &mut File) -> std::io::Result<u64> {
    let mut end = file.seek(SeekFrom::End(0))?;
    let mut block = [0; 4096];
    while end > 0 {
        let start = end.saturating_sub(block.len() as u64);
        let filled = &mut block[..(end - start) as usize];
        file.seek(SeekFrom::Start(start))?;
        file.read_exact(filled)?;
        if let Some(at) = filled.iter().rposition(|&byte| byte == b'\n') {
            return Ok(start + at as u64 + 1);
        }
        end = start;
    }
    Ok(0)
}

fn last_row<T: DeserializeOwned>(path: &Path) -> anyhow::Result<Option<T>> {
    let line = last_line(path).with_context(|| format!("cannot read {}", path.display()))?;
    line.map(|line| serde_json::from_slice(&line))
        .transpose()
        .with_context(|| format!("{}: the last line is damaged", path.display()))
}

/// Reads the last complete line that is not empty, among the file's last [`TAIL_BYTES`].
fn last_line(path: &Path) -> std::io::Result<Option<Vec<u8>>> {
    let Ok(mut file) = File::open(path) else { return Ok(None) };
    let whole = whole_len(&mut file)?;
    let start = whole.saturating_sub(TAIL_BYTES);
    file.seek(SeekFrom::Start(start))?;
    let mut tail = Vec::new();
    file.take(whole - start).read_to_end(&mut tail)?;
    Ok(tail.split(|&byte| byte == b'\n').rfind(|line| !line.is_empty()).map(<[u8]>::to_vec))
}

/// Calls `use_line` with the index and content of each complete line, without its line end. A
/// missing file has no lines.
fn for_each_line(
    path: &Path,
    mut use_line: impl FnMut(usize, &[u8]) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
    };
    let mut reader = BufReader::new(file);
    let mut line = Vec::new();
    for index in 0.. {
        line.clear();
        (&mut reader)
            .take(LINE_BYTES_MAX)
            .read_until(b'\n', &mut line)
            .with_context(|| format!("cannot read {}", path.display()))?;
        if line.pop() != Some(b'\n') {
            ensure!(
                (line.len() as u64) < LINE_BYTES_MAX - 1,
                "{}: a line is longer than {LINE_BYTES_MAX} bytes",
                path.display()
            );
            break;
        }
        use_line(index, &line)?;
    }
    Ok(())
}
