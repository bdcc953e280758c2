//! What a learner records as it goes: metrics, policies to be evaluated, checkpoints, progress.
//!
//! Called by [`crate::serve`] and by the one-process run for everything that falls due. Where the
//! records lie is the caller's business ([`RunFiles`]).

use std::error::Error;
use std::io;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use dmprl_shared::policy_file;
use dmprl_shared::supervision::{EvaluationRequest, Progress, Report, Supervisor};
use dmprl_shared::transport::delivery::Watermark;

use crate::checkpoint::{CheckpointError, Ended, Writer};
use crate::learner::{Counters, Learner};
use crate::metrics::MetricsLine;
use crate::session::{Due, DueError};

/// Interval between two progress reports.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(500);

/// Has a saved policy evaluated.
pub type Evaluate<'a> = &'a mut dyn FnMut(EvaluationRequest) -> Result<(), DueError>;

/// Where a learner's records lie: the run directory in the program, memory in a test.
pub trait RunFiles {
    /// Appends a whole line to `metrics.jsonl`, or nothing.
    ///
    /// # Errors
    /// What the file system refuses.
    fn append_metrics(&mut self, line: &[u8]) -> io::Result<()>;

    /// Saves a policy file under its version.
    ///
    /// # Errors
    /// What the file system refuses.
    fn save_policy(&mut self, version: u64, bytes: &[u8]) -> Result<(), DueError>;

    /// The folder of the checkpoints.
    fn checkpoints(&self) -> PathBuf;

    /// Called when a checkpoint of this moment begins.
    fn checkpoint_begins(&mut self, counters: &Counters);
}

/// Where the run's earlier sessions ended.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Past {
    /// Seconds of training.
    pub wall_s: f64,
    /// Environment steps at the newest metrics line and at the newest evaluation: a run that ends
    /// at one of them gets no second one.
    pub measured: Option<u64>,
    /// As above, of the newest evaluation.
    pub evaluated: Option<u64>,
}

/// Does what falls due in a session.
pub struct Recorder<'a> {
    files: &'a mut dyn RunFiles,
    supervisor: &'a dyn Supervisor,
    past: Past,
    started: Instant,
    line: Rate,
    progress: Rate,
    return_mean: Option<f64>,
    /// Median and largest, in the newest metrics line that had some.
    policy_lag: (u64, u64),
    checkpoints: Writer,
    /// Disk trouble is reported once until it is over: a full disk must not fill the terminal too.
    checkpoint_failing: bool,
    log_failing: bool,
}

/// Counts at a moment.
#[derive(Clone, Copy)]
struct Rate {
    at: Instant,
    env_steps: u64,
    updates: u64,
}

impl Rate {
    fn now(learner: &Learner) -> Self {
        let counters = learner.counters;
        Self { at: Instant::now(), env_steps: counters.env_steps, updates: counters.updates }
    }

    /// Environment steps and updates per second since `self`.
    fn until(self, now: Self) -> (f64, f64) {
        let seconds = now.at.duration_since(self.at).as_secs_f64().max(1e-6);
        let per_second = |from: u64, to: u64| to.saturating_sub(from) as f64 / seconds;
        (per_second(self.env_steps, now.env_steps), per_second(self.updates, now.updates))
    }
}

impl<'a> Recorder<'a> {
    /// A recorder of a session that begins now.
    pub fn new(
        files: &'a mut dyn RunFiles,
        past: Past,
        supervisor: &'a dyn Supervisor,
        learner: &Learner,
    ) -> Self {
        Self {
            checkpoints: Writer::new(files.checkpoints()),
            files,
            supervisor,
            past,
            started: Instant::now(),
            line: Rate::now(learner),
            progress: Rate::now(learner),
            return_mean: None,
            policy_lag: (0, 0),
            checkpoint_failing: false,
            log_failing: false,
        }
    }

    /// Seconds of training, over all sessions.
    fn wall_s(&self) -> f64 {
        self.past.wall_s + self.started.elapsed().as_secs_f64()
    }

    /// Does what is due. `evaluate` is called for an evaluation.
    ///
    /// # Errors
    /// Whatever `evaluate` returns. A full disk is no error: it is reported, and training goes on.
    pub fn due(
        &mut self,
        due: Due,
        learner: &mut Learner,
        evaluate: Evaluate<'_>,
    ) -> Result<(), DueError> {
        match due {
            Due::Metrics => self.write_metrics(learner),
            Due::Evaluation => {
                // A policy that cannot be saved is not evaluated; the training goes on.
                match self.save_policy(learner) {
                    Ok(request) => {
                        self.past.evaluated = Some(learner.counters.env_steps);
                        evaluate(request)
                    }
                    Err(error) => {
                        let (steps, why) = (learner.counters.env_steps, with_causes(&*error));
                        self.warn(format!("no evaluation at {steps} steps: {why}"));
                        Ok(())
                    }
                }
            }
            Due::Checkpoint => {
                self.begin_checkpoint(learner);
                Ok(())
            }
            Due::Refusal(why) => {
                self.warn(format!(
                    "a segment was refused ({why}); more of this kind are only counted, as \
                     `rejected` in metrics.jsonl"
                ));
                Ok(())
            }
            Due::Lost(count) => {
                self.warn(format!(
                    "{count} segments that a learner had acknowledged before it died are lost; \
                     delivery.level = \"log\" keeps them"
                ));
                Ok(())
            }
        }
    }

    /// The marks up to which segments may be acknowledged; none while the segment log cannot be
    /// written. Workers then wait as soon as their outboxes are full.
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

    /// Whether the learner has come further than the newest metrics line.
    #[must_use]
    pub fn is_unmeasured(&self, learner: &Learner) -> bool {
        self.past.measured != Some(learner.counters.env_steps)
    }

    /// Whether an evaluation that fell due before the learner's checkpoint has no row: the run was
    /// stopped before its evaluator answered.
    #[must_use]
    pub fn is_owed_an_evaluation(&self, learner: &Learner) -> bool {
        let interval = learner.config().evaluation.interval_steps;
        learner.counters.env_steps / interval > self.past.evaluated.unwrap_or(0) / interval
    }

    /// Whether the learner has come further than the newest evaluation.
    #[must_use]
    pub fn is_unevaluated(&self, learner: &Learner) -> bool {
        self.past.evaluated != Some(learner.counters.env_steps)
    }

    fn write_metrics(&mut self, learner: &mut Learner) -> Result<(), DueError> {
        self.past.measured = Some(learner.counters.env_steps);
        let now = Rate::now(learner);
        let (env_steps_per_s, updates_per_s) = self.line.until(now);
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
        self.policy_lag = line.policy_lag_p50.zip(line.policy_lag_max).unwrap_or(self.policy_lag);
        let mut text = serde_json::to_vec(&line)?;
        text.push(b'\n');
        // A full disk must not end a run: the line is lost, the training is not.
        if let Err(error) = self.files.append_metrics(&text) {
            self.warn(format!("a line of metrics.jsonl is lost: {error}"));
        }
        Ok(())
    }

    fn save_policy(&mut self, learner: &Learner) -> Result<EvaluationRequest, DueError> {
        let counters = learner.counters;
        let bytes = policy_file::encode(learner.policy(), learner.snapshot(), None)?;
        self.files.save_policy(counters.policy_version, &bytes)?;
        Ok(EvaluationRequest {
            env_steps: counters.env_steps,
            updates: counters.updates,
            segments: counters.segments,
            wall_s: self.wall_s(),
            policy_version: counters.policy_version,
        })
    }

    /// Begins a checkpoint of this moment, which is written while training goes on; only a
    /// deterministic run waits for it. Waits first for the one before if that is still being
    /// written: the disk is then slower than the run's interval.
    fn begin_checkpoint(&mut self, learner: &mut Learner) {
        self.end_checkpoint(learner);
        self.files.checkpoint_begins(&learner.counters);
        if let Err(error) = self.checkpoints.begin(learner) {
            self.report_checkpoint(learner.counters.env_steps, Err(error));
        } else if learner.config().run.deterministic {
            self.end_checkpoint(learner);
        }
    }

    /// Reports the checkpoint that was being written if it is complete, or failed.
    pub fn poll_checkpoint(&mut self, learner: &mut Learner) {
        if let Some(Ended { env_steps, written }) = self.checkpoints.poll(learner) {
            self.report_checkpoint(env_steps, written);
        }
    }

    fn end_checkpoint(&mut self, learner: &mut Learner) {
        if let Some(Ended { env_steps, written }) = self.checkpoints.wait(learner) {
            self.report_checkpoint(env_steps, written);
        }
    }

    /// Writes the session's last checkpoint.
    pub fn write_checkpoint(&mut self, learner: &mut Learner) {
        self.begin_checkpoint(learner);
        self.end_checkpoint(learner);
    }

    /// After a failure the previous checkpoint stays, and training goes on.
    fn report_checkpoint(&mut self, env_steps: u64, written: Result<String, CheckpointError>) {
        match written {
            Ok(name) => {
                self.checkpoint_failing = false;
                // The loop notices a supervisor that is gone.
                let _ = self.supervisor.report(&Report::Checkpoint { name, env_steps });
            }
            Err(error) if !self.checkpoint_failing => {
                self.checkpoint_failing = true;
                self.warn(format!("no checkpoint could be written, training goes on: {error}"));
            }
            Err(error) => eprintln!("checkpoint: {error}"),
        }
    }

    fn warn(&self, message: String) {
        eprintln!("warning: {message}");
        self.supervisor.warn(message);
    }

    /// Reports progress if it is time to.
    pub fn progress(&mut self, learner: &Learner) {
        if self.progress.at.elapsed() >= PROGRESS_INTERVAL {
            self.report_progress(learner);
        }
    }

    /// Reports progress.
    pub fn report_progress(&mut self, learner: &Learner) {
        let now = Rate::now(learner);
        let (env_steps_per_s, updates_per_s) = self.progress.until(now);
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
            policy_lag_p50: self.policy_lag.0,
            policy_lag_max: self.policy_lag.1,
            queued_segments: self.supervisor.totals().workers.queued_segments,
            restarts: counters.worker_restarts + counters.learner_restarts,
            rejected: counters.rejected.total(),
            env_failures: counters.env_failures,
        }));
    }
}

/// An error and its causes on one line.
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
