//! `RUN/tensorboard/`: the lines of `metrics.jsonl` and `evaluations.jsonl` once more, as an event
//! file that TensorBoard and all that read its files understand.
//!
//! The JSON lines are the truth and this is their mirror: whatever writes or rewinds them, in this
//! process or another, the mirror follows, and where they were replaced it begins again. Tags are
//! `training/` and `evaluation/` with the lines' own keys; the step is `env_steps`.

mod events;

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::Context;
use serde_json::Value;

use crate::run_directory::{RunDirectory, unix_s};
use crate::terminal::say;
use events::EventFile;

/// Between two looks for new lines.
const LOOK: Duration = Duration::from_secs(2);
/// Of new lines, at most so much is read at a time.
const READ_BYTES_MAX: u64 = 64 << 20;
/// The folder in the run directory.
const FOLDER: &str = "tensorboard";
/// The step of a line.
const STEP: &str = "env_steps";
/// When a line was written, in seconds of training.
const WALL: &str = "wall_s";

/// Follows a run's lines in a thread of its own, from [`Mirror::start`] until it is dropped, which
/// waits for the last lines.
pub struct Mirror {
    stop: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Mirror {
    /// Begins. What cannot be written is told once; a mirror is no reason for a run to fail.
    #[must_use]
    pub fn start(run: &RunDirectory) -> Self {
        let (stop, stopped) = mpsc::channel::<()>();
        let run = run.clone();
        let thread = std::thread::spawn(move || {
            let mut writer = Writer::new(&run);
            loop {
                let last = stopped.recv_timeout(LOOK) != Err(RecvTimeoutError::Timeout);
                if let Err(error) = writer.follow() {
                    say(&format!("warning: no more TensorBoard files: {error:#}"));
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
        // The thread sees it as the end and looks for a last time: its work is bounded by the lines
        // that are there.
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            // It does not panic; if it did, there is nothing to be done about a mirror.
            let _ = thread.join();
        }
    }
}

/// Writes the event file of a run.
pub struct Writer {
    folder: PathBuf,
    sources: [Source; 2],
    file: Option<(EventFile, PathBuf)>,
    /// Unix time at which the run's seconds of training began, seen from now.
    origin: f64,
}

struct Source {
    path: PathBuf,
    prefix: &'static str,
    /// The file's identity, and how much of it was read.
    inode: u64,
    offset: u64,
    was_replaced: bool,
}

impl Writer {
    /// For a run; nothing is written yet.
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

    /// Takes over the lines that are new.
    ///
    /// # Errors
    /// The file system refuses, or a whole line is no JSON object.
    pub fn follow(&mut self) -> anyhow::Result<()> {
        for index in 0..self.sources.len() {
            while let Some(lines) = self.sources[index].new_lines()? {
                if self.sources[index].was_replaced {
                    // All of both, into a new file.
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
                .with_context(|| format!("{}: a line is no JSON", path.display()))?;
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

    /// The next whole lines that were not read yet; none when there are no more for now. Notes if
    /// what was read is not what lies there now: a resume has gone back.
    fn new_lines(&mut self) -> anyhow::Result<Option<Vec<u8>>> {
        let cannot = || format!("cannot read {}", self.path.display());
        let mut file = match File::open(&self.path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            file => file.with_context(cannot)?,
        };
        // Of the file that is open: another may take its name at any moment.
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
        // One that is being written comes whole the next time.
        let whole = lines.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
        lines.truncate(whole);
        self.offset += whole as u64;
        Ok((whole > 0).then_some(lines))
    }
}

/// A new file, in the place of those of earlier sessions: all their lines are in it.
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
    // Whoever reads takes files in the order of their names.
    let now = (unix_s() * 1e9) as u64;
    let path = folder.join(format!("events.out.tfevents.{now}.{}", std::process::id()));
    let file = EventFile::create(&path, wall_time).with_context(refused)?;
    for old in old {
        std::fs::remove_file(&old).with_context(refused)?;
    }
    Ok((file, path))
}

/// Every number of an object, also of objects in it, by its path.
fn flatten(value: &Value, tag: &str, scalars: &mut Vec<(String, f64)>) {
    match value {
        Value::Object(entries) => {
            for (key, value) in entries.iter().filter(|(key, _)| *key != STEP) {
                let parted = tag.ends_with('/');
                flatten(value, &format!("{tag}{}{key}", if parted { "" } else { "/" }), scalars);
            }
        }
        Value::Number(number) => scalars.extend(number.as_f64().map(|n| (tag.to_owned(), n))),
        // Lists (an evaluation's returns) and what was not measured.
        _ => {}
    }
}

#[cfg(test)]
mod tests;
