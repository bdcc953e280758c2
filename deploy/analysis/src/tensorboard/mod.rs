//! Mirrors `metrics.jsonl` and `evaluations.jsonl` to an event file in `RUN/tensorboard/`, for
//! TensorBoard and compatible tools.
//!
//! The JSON Lines files are authoritative. The mirror copies what any process appends to them, and
//! starts a new event file if one of them was replaced. Tags are `training/` or `evaluation/`,
//! followed by the key of the line; the step is `env_steps`.

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
const POLL_INTERVAL: Duration = Duration::from_secs(2);
/// Maximum number of bytes per read.
const READ_BYTES_MAX: u64 = 64 << 20;
/// Folder in the run directory.
const FOLDER: &str = "tensorboard";
/// Key of a line's step.
const STEP_KEY: &str = "env_steps";
/// Key of a line's training time in seconds.
const WALL_TIME_KEY: &str = "wall_s";

/// A thread that mirrors the lines of a run. Dropping this waits until the last lines are written.
pub struct Mirror {
    stop: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Mirror {
    /// Starts the thread. On an error it logs a warning and stops; the run is unaffected.
    #[must_use]
    pub fn start(run: &RunDirectory) -> Self {
        let (stop, stopped) = mpsc::channel::<()>();
        let run = run.clone();
        let thread = std::thread::spawn(move || {
            let mut writer = Writer::new(&run);
            loop {
                let is_last = stopped.recv_timeout(POLL_INTERVAL) != Err(RecvTimeoutError::Timeout);
                if let Err(error) = writer.follow() {
                    warn!("stopped writing TensorBoard files: {error:#}");
                    return;
                }
                if is_last {
                    return;
                }
            }
        });
        Self { stop: Some(stop), thread: Some(thread) }
    }
}

impl Drop for Mirror {
    fn drop(&mut self) {
        // Disconnecting stops the thread after a last pass over the existing lines.
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            // The run does not depend on the mirror, so a panic of the thread is ignored.
            let _ = thread.join();
        }
    }
}

/// Writes the event file of a run.
pub struct Writer {
    folder: PathBuf,
    sources: [Source; 2],
    file: Option<(EventFile, PathBuf)>,
    /// Unix time that corresponds to a training time of 0.
    training_start_s: f64,
}

/// A JSON Lines file that is copied.
struct Source {
    path: PathBuf,
    /// Prefix of the tags.
    prefix: &'static str,
    inode: u64,
    /// Number of bytes read.
    offset: u64,
    was_replaced: bool,
}

impl Writer {
    /// Creates a writer. The event file is created with the first line.
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
            training_start_s: unix_s() - before,
        }
    }

    /// Copies new lines.
    ///
    /// # Errors
    /// A file cannot be read or written, or a complete line is not JSON.
    pub fn follow(&mut self) -> anyhow::Result<()> {
        for index in 0..self.sources.len() {
            while let Some(lines) = self.sources[index].new_lines()? {
                if self.sources[index].was_replaced {
                    // Copies both files again, into a new event file.
                    self.file = None;
                    self.sources.iter_mut().for_each(Source::rewind);
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
        let step = line[STEP_KEY].as_u64().unwrap_or(0);
        let wall_time = self.training_start_s + line[WALL_TIME_KEY].as_f64().unwrap_or(0.0);
        let (file, path) = match &mut self.file {
            Some(file) => file,
            None => self.file.insert(create_event_file(&self.folder, wall_time)?),
        };
        file.scalars(wall_time, step, &scalars)
            .with_context(|| format!("cannot write {}", path.display()))
    }
}

impl Source {
    fn rewind(&mut self) {
        self.offset = 0;
        self.was_replaced = false;
    }

    /// Returns the next complete unread lines; `None` if there are none. Sets `was_replaced` if the
    /// file was replaced, as a resume does.
    fn new_lines(&mut self) -> anyhow::Result<Option<Vec<u8>>> {
        let cannot = || format!("cannot read {}", self.path.display());
        let mut file = match File::open(&self.path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            file => file.with_context(cannot)?,
        };
        // Metadata of the open file, because the file at the path can be replaced at any time.
        let metadata = file.metadata().with_context(cannot)?;
        if self.offset > 0 && (metadata.ino() != self.inode || metadata.len() < self.offset) {
            self.was_replaced = true;
            return Ok(Some(Vec::new()));
        }
        self.inode = metadata.ino();
        let mut lines = Vec::new();
        file.seek(SeekFrom::Start(self.offset))
            .and_then(|_| file.take(READ_BYTES_MAX).read_to_end(&mut lines))
            .with_context(cannot)?;
        // An incomplete last line is left for the next call.
        let complete = lines.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
        lines.truncate(complete);
        self.offset += complete as u64;
        Ok((complete > 0).then_some(lines))
    }
}

/// Creates an event file, and removes those of earlier sessions. The new file will contain all
/// lines.
fn create_event_file(folder: &Path, wall_time: f64) -> anyhow::Result<(EventFile, PathBuf)> {
    let cannot = || format!("cannot create event files in {}", folder.display());
    std::fs::create_dir_all(folder).with_context(cannot)?;
    let old: Vec<_> = folder
        .read_dir()
        .with_context(cannot)?
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.to_string_lossy().contains("events.out.tfevents."))
        .collect();
    // The time is part of the name because readers process files in the order of their names.
    let now = (unix_s() * 1e9) as u64;
    let path = folder.join(format!("events.out.tfevents.{now}.{}", std::process::id()));
    let file = EventFile::create(&path, wall_time).with_context(cannot)?;
    for old in old {
        std::fs::remove_file(&old).with_context(cannot)?;
    }
    Ok((file, path))
}

/// Collects the numbers of an object and of nested objects. Tags are their paths.
fn flatten(value: &Value, tag: &str, scalars: &mut Vec<(String, f64)>) {
    match value {
        Value::Object(entries) => {
            for (key, value) in entries.iter().filter(|(key, _)| *key != STEP_KEY) {
                let separator = if tag.ends_with('/') { "" } else { "/" };
                flatten(value, &format!("{tag}{separator}{key}"), scalars);
            }
        }
        Value::Number(number) => scalars.extend(number.as_f64().map(|n| (tag.to_owned(), n))),
        // Lists, such as the returns of an evaluation, and null are skipped.
        _ => {}
    }
}

#[cfg(test)]
mod tests;
