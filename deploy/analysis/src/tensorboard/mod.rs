//! `RUN/tensorboard/`: mirrors `metrics.jsonl` and `evaluations.jsonl` as an event file for
//! TensorBoard and compatible tools.
//!
//! The JSON lines are authoritative. The mirror follows them, no matter which process writes or
//! rewinds them, and starts anew if they were replaced. Tags are `training/` and `evaluation/` with
//! the lines' own keys; the step is `env_steps`.

mod events;

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::Context;
use dmprl_run::{RunDirectory, unix_s};
use events::EventFile;
use serde_json::Value;
use tracing::warn;

/// Interval between checks for new lines.
const LOOK: Duration = Duration::from_secs(2);
/// Maximum number of bytes per read.
const READ_BYTES_MAX: u64 = 64 << 20;
/// Folder in the run directory.
const FOLDER: &str = "tensorboard";
/// Key of a line's step.
const STEP: &str = "env_steps";
/// Key of a line's training time in seconds.
const WALL: &str = "wall_s";

/// Mirrors a run's lines in a thread of its own. Dropping it waits until the last lines have been
/// written.
pub struct Mirror {
    stop: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Mirror {
    /// Starts the thread. An error is reported once and does not fail the run.
    #[must_use]
    pub fn start(run: &RunDirectory) -> Self {
        let (stop, stopped) = mpsc::channel::<()>();
        let run = run.clone();
        let thread = std::thread::spawn(move || {
            let mut writer = Writer::new(&run);
            loop {
                let last = stopped.recv_timeout(LOOK) != Err(RecvTimeoutError::Timeout);
                if let Err(error) = writer.follow() {
                    warn!("no more TensorBoard files: {error:#}");
                    return;
                }
                if last {
                    return;
                }
            }
        });
        Self { stop: Some(stop), thread: Some(thread) }
    }
}

impl Drop for Mirror {
    fn drop(&mut self) {
        // Disconnecting stops the thread after a last check. Its work is bounded by the lines
        // present.
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            // The thread does not panic; if it did, the run would still not depend on it.
            let _ = thread.join();
        }
    }
}

/// Writes the event file of a run.
pub struct Writer {
    folder: PathBuf,
    sources: [Source; 2],
    file: Option<(EventFile, PathBuf)>,
    /// Unix time at which the run's training time began, computed from the current time.
    origin: f64,
}

struct Source {
    path: PathBuf,
    prefix: &'static str,
    /// Inode of the file, and number of bytes read.
    inode: u64,
    offset: u64,
    was_replaced: bool,
}

impl Writer {
    /// Creates the writer without writing anything.
    #[must_use]
    pub fn new(run: &RunDirectory) -> Self {
        let source =
            |path, prefix| Source { path, prefix, inode: 0, offset: 0, was_replaced: false };
        let before = run.wall_s_before().unwrap_or(0.0);
        Self {
            folder: run.path().join(FOLDER),
            sources: [
                source(run.metrics_path(), "training/"),
                source(run.evaluations_path(), "evaluation/"),
            ],
            file: None,
            origin: unix_s() - before,
        }
    }

    /// Copies new lines.
    ///
    /// # Errors
    /// The file system fails, or a complete line is no JSON object.
    pub fn follow(&mut self) -> anyhow::Result<()> {
        for index in 0..self.sources.len() {
            while let Some(lines) = self.sources[index].new_lines()? {
                if self.sources[index].was_replaced {
                    // Copy both files completely into a new one.
                    self.file = None;
                    self.sources.iter_mut().for_each(Source::begin_again);
                    return self.follow();
                }
                self.write_all(index, &lines)?;
            }
        }
        match &mut self.file {
            Some((file, path)) => {
                file.flush().with_context(|| format!("cannot write {}", path.display()))
            }
            None => Ok(()),
        }
    }

    fn write_all(&mut self, index: usize, lines: &[u8]) -> anyhow::Result<()> {
        let (path, prefix) = (self.sources[index].path.clone(), self.sources[index].prefix);
        for line in lines.split(|&byte| byte == b'\n').filter(|line| !line.is_empty()) {
            let line: Value = serde_json::from_slice(line)
                .with_context(|| format!("{}: a line is not JSON", path.display()))?;
            self.write(&line, prefix)?;
        }
        Ok(())
    }

    fn write(&mut self, line: &Value, prefix: &str) -> anyhow::Result<()> {
        let mut scalars = Vec::new();
        flatten(line, prefix, &mut scalars);
        let step = line[STEP].as_u64().unwrap_or(0);
        let wall_time = self.origin + line[WALL].as_f64().unwrap_or(0.0);
        let (file, path) = match &mut self.file {
            Some(file) => file,
            None => self.file.insert(begin(&self.folder, wall_time)?),
        };
        file.scalars(wall_time, step, &scalars)
            .with_context(|| format!("cannot write {}", path.display()))
    }
}

impl Source {
    fn begin_again(&mut self) {
        self.offset = 0;
        self.was_replaced = false;
    }

    /// Returns the next complete unread lines; `None` if there are none. Detects that the file was
    /// replaced, which a resume does.
    fn new_lines(&mut self) -> anyhow::Result<Option<Vec<u8>>> {
        let cannot = || format!("cannot read {}", self.path.display());
        let mut file = match File::open(&self.path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            file => file.with_context(cannot)?,
        };
        // Metadata of the open file, because another file may take its name at any time.
        let now = file.metadata().with_context(cannot)?;
        if self.offset > 0 && (now.ino() != self.inode || now.len() < self.offset) {
            self.was_replaced = true;
            return Ok(Some(Vec::new()));
        }
        self.inode = now.ino();
        let mut lines = Vec::new();
        file.seek(SeekFrom::Start(self.offset))
            .and_then(|_| file.take(READ_BYTES_MAX).read_to_end(&mut lines))
            .with_context(cannot)?;
        // An incomplete line is read the next time.
        let whole = lines.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
        lines.truncate(whole);
        self.offset += whole as u64;
        Ok((whole > 0).then_some(lines))
    }
}

/// Creates a new file that replaces those of earlier sessions, whose lines it will contain.
fn begin(folder: &Path, wall_time: f64) -> anyhow::Result<(EventFile, PathBuf)> {
    let refused = || format!("cannot make event files in {}", folder.display());
    std::fs::create_dir_all(folder).with_context(refused)?;
    let old: Vec<_> = folder
        .read_dir()
        .with_context(refused)?
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.to_string_lossy().contains("events.out.tfevents."))
        .collect();
    // Readers process files in the order of their names.
    let now = (unix_s() * 1e9) as u64;
    let path = folder.join(format!("events.out.tfevents.{now}.{}", std::process::id()));
    let file = EventFile::create(&path, wall_time).with_context(refused)?;
    for old in old {
        std::fs::remove_file(&old).with_context(refused)?;
    }
    Ok((file, path))
}

/// Collects every number of an object and of nested objects, by its path.
fn flatten(value: &Value, tag: &str, scalars: &mut Vec<(String, f64)>) {
    match value {
        Value::Object(entries) => {
            for (key, value) in entries.iter().filter(|(key, _)| *key != STEP) {
                let parted = tag.ends_with('/');
                flatten(value, &format!("{tag}{}{key}", if parted { "" } else { "/" }), scalars);
            }
        }
        Value::Number(number) => scalars.extend(number.as_f64().map(|n| (tag.to_owned(), n))),
        // Skips lists (an evaluation's returns) and null.
        _ => {}
    }
}

#[cfg(test)]
mod tests;
