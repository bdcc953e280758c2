//! Writes a learner's records: metrics, policies to evaluate, checkpoints and progress.
//!
//! Called by [`crate::serve`] and by the one-process run when a record is due. The caller decides
//! where the records are stored ([`RunFiles`]).

use std::error::Error;
use std::io;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use dmprl_shared::policy_file;
use dmprl_shared::supervision::{EvaluationRequest, Progress, Report, Supervisor};
use dmprl_shared::transport::delivery::Watermark;
use tracing::warn;

use crate::checkpoint::{CheckpointError, WriteOutcome, Writer};
use crate::learner::{Counters, Learner};
use crate::metrics::{MetricsLine, PolicyLag};
use crate::session::{Due, DueError};

/// Interval between two progress reports.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(500);
/// Interval between checks whether a checkpoint is written, short compared to writing one.
const CHECKPOINT_CHECK_INTERVAL: Duration = Duration::from_millis(1);

/// Requests the evaluation of a saved policy.
pub type Evaluate<'a> = &'a mut dyn FnMut(EvaluationRequest) -> Result<(), DueError>;

/// Storage of a learner's records: the run directory in the program, memory in tests.
pub trait RunFiles {
    /// Appends a line to `metrics.jsonl`, completely or not at all.
    ///
    /// # Errors
    /// If the file system fails.
    fn append_metrics(&mut self, line: &[u8]) -> io::Result<()>;

    /// Saves a policy file under its version number.
    ///
    /// # Errors
    /// If the file system fails.
    fn save_policy(&mut self, version: u64, bytes: &[u8]) -> Result<(), DueError>;

    /// Returns the folder of the checkpoints.
    fn checkpoints(&self) -> PathBuf;

    /// Called when a checkpoint with these counters begins.
    fn checkpoint_begins(&mut self, counters: &Counters);
}

/// The state of the run's records at the end of its previous sessions.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PreviousSessions {
    /// Training time \[s\].
    pub wall_s: f64,
    /// Environment steps at the newest metrics line. A run that ends there gets no second line.
    pub measured: Option<u64>,
    /// Environment steps at the newest evaluation. A run that ends there gets no second evaluation.
    pub evaluated: Option<u64>,
}

/// Writes the records of a session.
pub struct Recorder<'a> {
    files: &'a mut dyn RunFiles,
    supervisor: &'a dyn Supervisor,
    previous: PreviousSessions,
    started: Instant,
    line: CounterSample,
    progress: CounterSample,
    return_mean: Option<f64>,
    /// From the newest metrics line that had any.
    policy_lag: PolicyLag,
    checkpoints: Writer,
    /// A failing disk is reported once until it recovers, so that it does not fill the terminal.
    checkpoint_failing: bool,
    log_failing: bool,
}

/// Counters at a point in time.
#[derive(Clone, Copy)]
struct CounterSample {
    at: Instant,
    env_steps: u64,
    updates: u64,
}

impl CounterSample {
    fn now(learner: &Learner) -> Self {
        let counters = learner.counters;
        Self { at: Instant::now(), env_steps: counters.env_steps, updates: counters.updates }
    }

    /// Returns the rates since `self`.
    fn rates_until(self, now: Self) -> Rates {
        let seconds = now.at.duration_since(self.at).as_secs_f64().max(1e-6);
        let per_second = |from: u64, to: u64| to.saturating_sub(from) as f64 / seconds;
        Rates {
            env_steps_per_s: per_second(self.env_steps, now.env_steps),
            updates_per_s: per_second(self.updates, now.updates),
        }
    }
}

/// Speed between two points in time.
struct Rates {
    env_steps_per_s: f64,
    updates_per_s: f64,
}

impl<'a> Recorder<'a> {
    /// Makes the recorder of a session that begins now.
    pub fn new(
        files: &'a mut dyn RunFiles,
        previous: PreviousSessions,
        supervisor: &'a dyn Supervisor,
        learner: &Learner,
    ) -> Self {
        Self {
            checkpoints: Writer::new(files.checkpoints()),
            files,
            supervisor,
            previous,
            started: Instant::now(),
            line: CounterSample::now(learner),
            progress: CounterSample::now(learner),
            return_mean: None,
            policy_lag: PolicyLag::default(),
            checkpoint_failing: false,
            log_failing: false,
        }
    }

    /// Returns the training time, over all sessions \[s\].
    fn wall_s(&self) -> f64 {
        self.previous.wall_s + self.started.elapsed().as_secs_f64()
    }

    /// Writes the record that is due. Calls `evaluate` for an evaluation.
    ///
    /// # Errors
    /// Errors of `evaluate`, and a checkpoint of networks that are not finite. A full disk is only
    /// reported; training continues.
    pub fn due(
        &mut self,
        due: Due,
        learner: &mut Learner,
        evaluate: Evaluate<'_>,
    ) -> Result<(), DueError> {
        match due {
            Due::Metrics => self.write_metrics(learner),
            Due::Evaluation => {
                // A policy that cannot be saved is not evaluated; training continues.
                match self.save_policy(learner) {
                    Ok(request) => {
                        self.previous.evaluated = Some(learner.counters.env_steps);
                        evaluate(request)
                    }
                    Err(error) => {
                        let (steps, why) = (learner.counters.env_steps, with_causes(&*error));
                        self.warn(format!(
                            "no evaluation at {steps} steps: cannot save the policy: {why}"
                        ));
                        Ok(())
                    }
                }
            }
            Due::Checkpoint => Ok(self.begin_checkpoint(learner)?),
            Due::Rejection(why) => {
                self.warn(format!(
                    "a segment was rejected ({why}); further ones of this kind are only counted, \
                     as `rejected` in metrics.jsonl"
                ));
                Ok(())
            }
            Due::Lost(count) => {
                self.warn(format!(
                    "{count} segments are lost that a crashed learner had acknowledged; \
                     delivery.level = \"log\" keeps such segments"
                ));
                Ok(())
            }
        }
    }

    /// Returns the marks up to which segments may be acknowledged, or `None` while the segment log
    /// cannot be written. Workers then wait as soon as their outboxes are full.
    pub fn acknowledge<'l>(&mut self, learner: &'l mut Learner) -> Option<&'l [Watermark]> {
        match learner.inbox.acknowledge() {
            Ok(marks) => {
                self.log_failing = false;
                Some(marks)
            }
            Err(error) => {
                if !std::mem::replace(&mut self.log_failing, true) {
                    self.warn(format!("no segment can be acknowledged: {error}"));
                }
                None
            }
        }
    }

    /// Returns whether the newest metrics line is outdated.
    #[must_use]
    pub fn is_unmeasured(&self, learner: &Learner) -> bool {
        self.previous.measured != Some(learner.counters.env_steps)
    }

    /// Returns whether an evaluation that was due before the learner's checkpoint is missing,
    /// because the run was stopped before the evaluator answered.
    #[must_use]
    pub fn is_owed_an_evaluation(&self, learner: &Learner) -> bool {
        let interval = learner.config().evaluation.interval_steps;
        learner.counters.env_steps / interval > self.previous.evaluated.unwrap_or(0) / interval
    }

    /// Returns whether the newest evaluation is outdated.
    #[must_use]
    pub fn is_unevaluated(&self, learner: &Learner) -> bool {
        self.previous.evaluated != Some(learner.counters.env_steps)
    }

    fn write_metrics(&mut self, learner: &mut Learner) -> Result<(), DueError> {
        self.previous.measured = Some(learner.counters.env_steps);
        let now = CounterSample::now(learner);
        let Rates { env_steps_per_s, updates_per_s } = self.line.rates_until(now);
        self.line = now;
        let workers = self.supervisor.totals().workers;
        let line = MetricsLine {
            wall_s: self.wall_s(),
            env_steps_per_s,
            updates_per_s,
            workers: if learner.config().run.deterministic { 1 } else { workers.count },
            queued_segments: workers.queued_segments,
            ..learner.metrics_line()
        };
        self.return_mean = line.training_return_mean.or(self.return_mean);
        if let (Some(median), Some(max)) = (line.policy_lag_p50, line.policy_lag_max) {
            self.policy_lag = PolicyLag { median, max };
        }
        let mut text = serde_json::to_vec(&line)?;
        text.push(b'\n');
        // A full disk must not end a run, so the line is dropped.
        if let Err(error) = self.files.append_metrics(&text) {
            self.warn(format!("cannot write a line of metrics.jsonl: {error}"));
        }
        Ok(())
    }

    fn save_policy(&mut self, learner: &Learner) -> Result<EvaluationRequest, DueError> {
        let counters = learner.counters;
        let bytes = policy_file::encode(learner.policy(), &learner.saved_snapshot(), None, None)?;
        self.files.save_policy(counters.policy_version, &bytes)?;
        Ok(EvaluationRequest {
            env_steps: counters.env_steps,
            updates: counters.updates,
            segments: counters.segments,
            wall_s: self.wall_s(),
            policy_version: counters.policy_version,
        })
    }

    /// Begins a checkpoint, which is written in the background. A deterministic run waits until it
    /// is written. If the previous checkpoint is still being written, because the disk is too slow
    /// for the interval, this waits for it first.
    ///
    /// # Errors
    /// If a network is not finite. A disk that fails is only reported; training continues.
    fn begin_checkpoint(&mut self, learner: &mut Learner) -> Result<(), CheckpointError> {
        self.finish_checkpoint(learner);
        self.files.checkpoint_begins(&learner.counters);
        match self.checkpoints.begin(learner) {
            Ok(()) if learner.config().run.deterministic => self.finish_checkpoint(learner),
            Ok(()) => {}
            Err(error @ CheckpointError::NotFinite { .. }) => return Err(error),
            Err(error) => self.report_checkpoint(learner.counters.env_steps, Err(error)),
        }
        Ok(())
    }

    /// Reports the checkpoint that was being written, once it is complete or has failed.
    pub fn poll_checkpoint(&mut self, learner: &mut Learner) {
        if let Some(WriteOutcome { env_steps, result }) = self.checkpoints.poll(learner) {
            self.report_checkpoint(env_steps, result);
        }
    }

    /// Waits for the checkpoint that is being written. Progress is reported meanwhile, because a
    /// learner that is silent counts as hung.
    fn finish_checkpoint(&mut self, learner: &mut Learner) {
        while self.checkpoints.is_writing() {
            self.progress(learner);
            std::thread::sleep(CHECKPOINT_CHECK_INTERVAL);
        }
        if let Some(WriteOutcome { env_steps, result }) = self.checkpoints.wait(learner) {
            self.report_checkpoint(env_steps, result);
        }
    }

    /// Writes the session's last checkpoint and waits for it.
    ///
    /// # Errors
    /// If a network is not finite. A disk that fails is only reported.
    pub fn write_checkpoint(&mut self, learner: &mut Learner) -> Result<(), CheckpointError> {
        self.begin_checkpoint(learner)?;
        self.finish_checkpoint(learner);
        Ok(())
    }

    /// Reports a checkpoint. After a failure the previous checkpoint stays, and training continues.
    fn report_checkpoint(&mut self, env_steps: u64, result: Result<String, CheckpointError>) {
        match result {
            Ok(name) => {
                self.checkpoint_failing = false;
                // The loop notices when the supervisor is gone.
                let _ = self.supervisor.report(&Report::Checkpoint { name, env_steps });
            }
            Err(error) if !self.checkpoint_failing => {
                self.checkpoint_failing = true;
                self.warn(format!("no checkpoint could be written, training continues: {error}"));
            }
            Err(error) => warn!("no checkpoint: {error}"),
        }
    }

    fn warn(&self, message: String) {
        warn!("{message}");
        self.supervisor.warn(message);
    }

    /// Reports progress if the interval has passed.
    pub fn progress(&mut self, learner: &Learner) {
        if self.progress.at.elapsed() >= PROGRESS_INTERVAL {
            self.report_progress(learner);
        }
    }

    /// Reports progress.
    pub fn report_progress(&mut self, learner: &Learner) {
        let now = CounterSample::now(learner);
        let Rates { env_steps_per_s, updates_per_s } = self.progress.rates_until(now);
        self.progress = now;
        let counters = learner.counters;
        let _ = self.supervisor.report(&Report::Progress(Progress {
            env_steps: counters.env_steps,
            updates: counters.updates,
            segments: counters.segments,
            env_steps_per_s,
            updates_per_s,
            return_mean: self.return_mean,
            samples_per_insert: learner.samples_per_insert(),
            policy_lag_p50: self.policy_lag.median,
            policy_lag_max: self.policy_lag.max,
            queued_segments: self.supervisor.totals().workers.queued_segments,
            restarts: counters.worker_restarts + counters.learner_restarts,
            rejected: counters.rejected.total(),
            env_failures: counters.env_failures,
        }));
    }
}

/// Formats an error and its causes on one line.
fn with_causes(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text.push_str(": ");
        text.push_str(&error.to_string());
        cause = error.source();
    }
    text
}
