//! Checkpoints written while training goes on: one at a time, by a thread of its own.

use std::path::PathBuf;
use std::thread::JoinHandle;

use super::{CheckpointError, Cut};
use crate::learner::Learner;

/// What became of a checkpoint.
#[derive(Debug)]
pub struct Ended {
    /// Environment steps of its moment.
    pub env_steps: u64,
    /// Its name, or why there is none.
    pub written: Result<String, CheckpointError>,
}

/// Writes checkpoints into a folder.
#[derive(Debug)]
pub struct Writer {
    folder: PathBuf,
    under_way: Option<UnderWay>,
}

#[derive(Debug)]
struct UnderWay {
    env_steps: u64,
    logged: u64,
    thread: JoinHandle<Result<String, CheckpointError>>,
}

impl Writer {
    /// One that writes nothing yet.
    #[must_use]
    pub fn new(folder: PathBuf) -> Self {
        Self { folder, under_way: None }
    }

    /// Whether one is being written.
    #[must_use]
    pub fn is_busy(&self) -> bool {
        self.under_way.is_some()
    }

    /// Begins to write a checkpoint of this moment.
    ///
    /// # Errors
    /// If there can be none: the networks cannot be fetched, or no thread be started.
    ///
    /// # Panics
    /// If one is being written.
    pub fn begin(&mut self, learner: &mut Learner) -> Result<(), CheckpointError> {
        assert!(!self.is_busy(), "one checkpoint at a time");
        let cut = Cut::of(learner)?;
        let (env_steps, logged) = (cut.state.counters.env_steps, cut.logged);
        let folder = self.folder.clone();
        let thread = std::thread::Builder::new().name("checkpoint".into());
        let thread = thread
            .spawn(move || cut.write(&folder))
            .map_err(|cause| CheckpointError::Io { path: self.folder.clone(), cause })?;
        self.under_way = Some(UnderWay { env_steps, logged, thread });
        Ok(())
    }

    /// What became of the one that was being written, if it is over. The segment log forgets what
    /// it holds.
    pub fn poll(&mut self, learner: &mut Learner) -> Option<Ended> {
        let over = self.under_way.as_ref().is_some_and(|it| it.thread.is_finished());
        if over { self.wait(learner) } else { None }
    }

    /// The same, and waits for it.
    pub fn wait(&mut self, learner: &mut Learner) -> Option<Ended> {
        let UnderWay { env_steps, logged, thread } = self.under_way.take()?;
        let written = thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        let written = written.and_then(|name| {
            let forgotten = learner.inbox.checkpointed(logged);
            forgotten.map(|()| name).map_err(|cause| CheckpointError::Log { cause })
        });
        Some(Ended { env_steps, written })
    }
}

impl Drop for Writer {
    /// A learner that fails leaves the checkpoint that it has begun.
    fn drop(&mut self) {
        if let Some(UnderWay { thread, .. }) = self.under_way.take() {
            // What became of it is in the folder.
            let _ = thread.join();
        }
    }
}
