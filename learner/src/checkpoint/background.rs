//! Writes checkpoints in the background, one at a time, on its own thread.

use std::path::PathBuf;
use std::thread::JoinHandle;

use super::{CheckpointContents, CheckpointError};
use crate::learner::Learner;

/// The outcome of writing a checkpoint.
#[derive(Debug)]
pub struct WriteOutcome {
    /// Environment steps when the checkpoint began.
    pub env_steps: u64,
    /// Name of the checkpoint, or the error.
    pub result: Result<String, CheckpointError>,
}

/// Writes checkpoints into a folder.
#[derive(Debug)]
pub struct Writer {
    folder: PathBuf,
    in_progress: Option<InProgress>,
}

#[derive(Debug)]
struct InProgress {
    env_steps: u64,
    logged: u64,
    thread: JoinHandle<Result<String, CheckpointError>>,
}

impl Writer {
    /// Makes an idle writer.
    #[must_use]
    pub fn new(folder: PathBuf) -> Self {
        Self { folder, in_progress: None }
    }

    /// Returns whether a checkpoint is being written.
    #[must_use]
    pub fn is_busy(&self) -> bool {
        self.in_progress.is_some()
    }

    /// Returns whether the thread that writes a checkpoint is running.
    #[must_use]
    pub fn is_writing(&self) -> bool {
        self.in_progress.as_ref().is_some_and(|it| !it.thread.is_finished())
    }

    /// Captures the learner's state and begins to write it.
    ///
    /// # Errors
    /// If a network is not finite or cannot be copied from the device, or no thread can be started.
    ///
    /// # Panics
    /// If a checkpoint is being written.
    pub fn begin(&mut self, learner: &mut Learner) -> Result<(), CheckpointError> {
        assert!(!self.is_busy(), "one checkpoint at a time");
        let contents = CheckpointContents::capture(learner)?;
        let (env_steps, logged) = (contents.state.counters.env_steps, contents.logged);
        let folder = self.folder.clone();
        let thread = std::thread::Builder::new().name("checkpoint".into());
        let thread = thread
            .spawn(move || contents.write(&folder))
            .map_err(|cause| CheckpointError::Io { path: self.folder.clone(), cause })?;
        self.in_progress = Some(InProgress { env_steps, logged, thread });
        Ok(())
    }

    /// Returns the outcome of the checkpoint that was being written, if it is finished. Then
    /// removes its segments from the segment log.
    pub fn poll(&mut self, learner: &mut Learner) -> Option<WriteOutcome> {
        let finished = self.in_progress.as_ref().is_some_and(|it| it.thread.is_finished());
        if finished { self.wait(learner) } else { None }
    }

    /// Waits for the checkpoint that is being written, if any, and returns its outcome. Then
    /// removes its segments from the segment log.
    pub fn wait(&mut self, learner: &mut Learner) -> Option<WriteOutcome> {
        let InProgress { env_steps, logged, thread } = self.in_progress.take()?;
        let written = thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        let result = written.and_then(|name| {
            let emptied = learner.inbox.checkpointed(logged);
            emptied.map(|()| name).map_err(|cause| CheckpointError::Log { cause })
        });
        Some(WriteOutcome { env_steps, result })
    }
}

impl Drop for Writer {
    /// Waits for the checkpoint that is being written, so that a failing learner completes it.
    fn drop(&mut self) {
        if let Some(InProgress { thread, .. }) = self.in_progress.take() {
            // The outcome is not needed: an incomplete checkpoint is never loaded.
            let _ = thread.join();
        }
    }
}
