//! `finished.jsonl`: the finished runs of a sweep, and the duration of each.

use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use serde::{Deserialize, Serialize};

/// A finished run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Finished {
    /// Run directory, relative to the sweep's.
    pub run: PathBuf,
    /// Configured number of environment steps.
    pub steps: u64,
    /// Actual number of environment steps, which is lower if the run reached its goal.
    pub env_steps: u64,
    /// Training time over all its sessions \[s\].
    pub wall_s: f64,
    /// Whether it finished or was pruned.
    #[serde(default, skip_serializing_if = "End::is_finished")]
    pub state: End,
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum End {
    /// It completed its steps or reached its goal.
    #[default]
    Finished,
    /// A search pruned its trial.
    Pruned,
}

impl End {
    /// Returns true if the run finished by itself.
    #[must_use]
    pub fn is_finished(&self) -> bool {
        *self == Self::Finished
    }
}

impl Finished {
    /// Returns true if the run finished with at least this number of configured steps.
    #[must_use]
    pub fn is_whole(&self, steps: u64) -> bool {
        self.state.is_finished() && self.steps >= steps
    }
}

/// The file and its entries.
#[derive(Debug)]
pub struct Ledger {
    path: PathBuf,
    finished: Vec<Finished>,
}

impl Ledger {
    /// Reads the ledger of a sweep's directory, if it exists. An incomplete last line, left by a
    /// kill, is ignored.
    ///
    /// # Errors
    /// A complete line is invalid, or the file system fails.
    pub fn open(sweep: &Path) -> anyhow::Result<Self> {
        let path = sweep.join("finished.jsonl");
        let mut text = String::new();
        match File::open(&path) {
            Ok(mut file) => {
                file.read_to_string(&mut text)
                    .with_context(|| format!("cannot read {}", path.display()))?;
            }
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
            Err(error) => {
                return Err(error).with_context(|| format!("cannot open {}", path.display()));
            }
        }
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        let finished = whole.lines().enumerate().map(|(index, line)| {
            serde_json::from_str(line)
                .with_context(|| format!("{}, line {}: invalid entry", path.display(), index + 1))
        });
        let finished = finished.collect::<anyhow::Result<_>>()?;
        Ok(Self { path, finished })
    }

    /// Returns the newest entry of a run, which has several if it was extended.
    #[must_use]
    pub fn of(&self, run: &Path) -> Option<&Finished> {
        self.finished.iter().rev().find(|finished| finished.run == run)
    }

    /// Adds an entry, to the file first.
    ///
    /// # Errors
    /// The file system fails.
    pub fn add(&mut self, finished: Finished) -> anyhow::Result<()> {
        let write = || -> anyhow::Result<()> {
            let mut file =
                OpenOptions::new().read(true).append(true).create(true).open(&self.path)?;
            let mut text = Vec::new();
            file.read_to_end(&mut text)?;
            if text.last().is_some_and(|&byte| byte != b'\n') {
                // An incomplete line, left by a kill.
                let whole = text.iter().rposition(|&byte| byte == b'\n').map_or(0, |end| end + 1);
                file.set_len(whole as u64)?;
            }
            let mut line = serde_json::to_vec(&finished)?;
            line.push(b'\n');
            file.write_all(&line)?;
            Ok(file.sync_data()?)
        };
        write().with_context(|| format!("cannot add to {}", self.path.display()))?;
        self.finished.push(finished);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn finished(run: &str, env_steps: u64) -> Finished {
        let state = End::Finished;
        Finished { run: run.into(), steps: env_steps, env_steps, wall_s: 1.5, state }
    }

    #[test]
    fn added_entries_are_read_back_and_a_partial_line_is_ignored() {
        let folder = tempfile::tempdir().unwrap();
        let mut ledger = Ledger::open(folder.path()).unwrap();
        assert_eq!(ledger.of(Path::new("a")), None);
        ledger.add(finished("a", 5)).unwrap();
        ledger.add(finished("b", 6)).unwrap();
        let path = folder.path().join("finished.jsonl");
        let mut file = OpenOptions::new().append(true).open(&path).unwrap();
        file.write_all(b"{\"run\": \"c").unwrap();
        let mut ledger = Ledger::open(folder.path()).unwrap();
        ledger.add(finished("a", 7)).unwrap();
        for ledger in [&ledger, &Ledger::open(folder.path()).unwrap()] {
            assert_eq!(ledger.of(Path::new("a")), Some(&finished("a", 7)));
            assert_eq!(ledger.of(Path::new("b")), Some(&finished("b", 6)));
            assert_eq!(ledger.of(Path::new("c")), None);
        }
    }

    #[test]
    fn a_pruned_run_is_not_whole() {
        let folder = tempfile::tempdir().unwrap();
        let mut ledger = Ledger::open(folder.path()).unwrap();
        ledger.add(Finished { state: End::Pruned, ..finished("a", 5) }).unwrap();
        ledger.add(finished("b", 5)).unwrap();
        let text = std::fs::read_to_string(folder.path().join("finished.jsonl")).unwrap();
        assert_eq!(text.matches("state").count(), 1, "{text}");
        let ledger = Ledger::open(folder.path()).unwrap();
        let is_whole = |run: &str| ledger.of(Path::new(run)).is_some_and(|run| run.is_whole(5));
        assert_eq!([is_whole("a"), is_whole("b")], [false, true]);
    }

    #[test]
    fn an_invalid_line_is_reported_with_its_number() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("finished.jsonl"), "{}\n").unwrap();
        let error = format!("{:#}", Ledger::open(folder.path()).unwrap_err());
        assert!(error.contains("line 1"), "{error}");
    }
}
