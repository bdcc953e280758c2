//! What the learner leaves behind as it goes: metrics, policies, checkpoints, progress.

use std::fs::File;
use std::io::Write;
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_learner::checkpoint::{CheckpointError, Ended, Writer};
use dmprl_learner::learner::Learner;
use dmprl_learner::metrics::MetricsLine;
use dmprl_learner::session::Due;
use dmprl_shared::policy_file;
use dmprl_shared::transport::delivery::Mark;

use super::ControlPipe;
use crate::control::{EvaluationRequest, Progress, Report};
use crate::journal::{Entry, Journal};
use crate::run_directory::{RunDirectory, replace_file};

/// Between two progress reports.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(500);

/// Has a saved policy evaluated.
pub type Evaluate<'a> = &'a mut dyn FnMut(EvaluationRequest) -> anyhow::Result<()>;

/// Answers what falls due in a session.
pub struct Recorder<'a> {
    run: &'a RunDirectory,
    control: &'a ControlPipe,
    metrics: File,
    started: Instant,
    wall_s_before: f64,
    /// Environment steps of the newest metrics line and of the newest evaluation asked for: a run
    /// that ends where one of them is gets no second one.
    measured: Option<u64>,
    evaluated: Option<u64>,
    line: Rate,
    progress: Rate,
    return_mean: Option<f64>,
    /// Median and largest, in the newest metrics line that had some.
    policy_lag: (u64, u64),
    checkpoints: Writer,
    /// Disk trouble is told once until it is over: a full disk must not fill the terminal too.
    checkpoint_failing: bool,
    log_failing: bool,
    /// Where somebody wants to know of every checkpoint.
    journal: Option<Journal>,
}

/// Counts since a moment.
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
    pub fn new(
        run: &'a RunDirectory,
        control: &'a ControlPipe,
        learner: &Learner,
    ) -> anyhow::Result<Self> {
        let path = run.metrics_path();
        let metrics = File::options().append(true).create(true).open(&path);
        Ok(Self {
            run,
            control,
            metrics: metrics.with_context(|| format!("cannot open {}", path.display()))?,
            started: Instant::now(),
            wall_s_before: run.wall_s_before()?,
            measured: run.measured_steps()?,
            evaluated: run.latest_row()?.map(|row| row.env_steps),
            line: Rate::now(learner),
            progress: Rate::now(learner),
            return_mean: None,
            policy_lag: (0, 0),
            checkpoints: Writer::new(run.checkpoints_path()),
            checkpoint_failing: false,
            log_failing: false,
            journal: None,
        })
    }

    /// Notes checkpoints in a journal from now on, if there is one.
    pub fn note_in(&mut self, journal: Option<Journal>) {
        self.journal = journal;
    }

    /// Seconds of training, over all sessions.
    fn wall_s(&self) -> f64 {
        self.wall_s_before + self.started.elapsed().as_secs_f64()
    }

    /// Does what is due. An evaluation is asked for by `evaluate`.
    pub fn due(
        &mut self,
        due: Due,
        learner: &mut Learner,
        evaluate: Evaluate<'_>,
    ) -> anyhow::Result<()> {
        match due {
            Due::Metrics => self.write_metrics(learner),
            Due::Evaluation => {
                // A policy that cannot be saved is not evaluated; the training goes on.
                match self.save_policy(learner) {
                    Ok(request) => {
                        self.evaluated = Some(learner.counters.env_steps);
                        evaluate(request)
                    }
                    Err(error) => {
                        let steps = learner.counters.env_steps;
                        self.warn(format!("no evaluation at {steps} steps: {error:#}"));
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

    /// What may be acknowledged, unless the segment log cannot be written: workers then wait, as
    /// soon as they can keep no more.
    pub fn acknowledge<'l>(&mut self, learner: &'l mut Learner) -> Option<&'l [Mark]> {
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
    pub fn is_unmeasured(&self, learner: &Learner) -> bool {
        self.measured != Some(learner.counters.env_steps)
    }

    /// Whether an evaluation that fell due before the learner's checkpoint has no row: the run was
    /// stopped before its evaluator answered.
    pub fn is_owed_an_evaluation(&self, learner: &Learner) -> bool {
        let interval = learner.config().evaluation.interval_steps;
        learner.counters.env_steps / interval > self.evaluated.unwrap_or(0) / interval
    }

    /// Whether the learner has come further than the newest evaluation.
    pub fn is_unevaluated(&self, learner: &Learner) -> bool {
        self.evaluated != Some(learner.counters.env_steps)
    }

    fn write_metrics(&mut self, learner: &mut Learner) -> anyhow::Result<()> {
        self.measured = Some(learner.counters.env_steps);
        let now = Rate::now(learner);
        let (env_steps_per_s, updates_per_s) = self.line.until(now);
        self.line = now;
        let workers = self.control.workers();
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
        let mut text = serde_json::to_vec(&line).context("cannot write metrics as JSON")?;
        text.push(b'\n');
        // A disk that is full must not end a run: the line is lost, the training is not.
        let before = self.metrics.metadata().map(|metadata| metadata.len());
        if let Err(error) = self.metrics.write_all(&text) {
            // Half a line would spoil the next one.
            let _ = before.and_then(|len| self.metrics.set_len(len));
            self.warn(format!("a line of metrics.jsonl is lost: {error}"));
        }
        Ok(())
    }

    fn save_policy(&self, learner: &Learner) -> anyhow::Result<EvaluationRequest> {
        let counters = learner.counters;
        let path = self.run.policy_path(counters.policy_version);
        replace_file(&path, &policy_file::encode(learner.policy(), learner.snapshot(), None)?)?;
        Ok(EvaluationRequest {
            env_steps: counters.env_steps,
            updates: counters.updates,
            segments: counters.segments,
            wall_s: self.wall_s(),
            policy_version: counters.policy_version,
        })
    }

    /// Begins a checkpoint of this moment, which is written while training goes on; only a
    /// deterministic run waits for it. One that falls due while the one before is being written
    /// waits for that first: the disk is then slower than the run's interval.
    fn begin_checkpoint(&mut self, learner: &mut Learner) {
        self.end_checkpoint(learner);
        if let Some(journal) = &self.journal {
            journal.note(Entry::Cut((&learner.counters).into()));
        }
        if let Err(error) = self.checkpoints.begin(learner) {
            self.tell_of_checkpoint(learner.counters.env_steps, Err(error));
        } else if learner.config().run.deterministic {
            self.end_checkpoint(learner);
        }
    }

    /// Looks whether the checkpoint that is being written is there.
    pub fn poll_checkpoint(&mut self, learner: &mut Learner) {
        if let Some(Ended { env_steps, written }) = self.checkpoints.poll(learner) {
            self.tell_of_checkpoint(env_steps, written);
        }
    }

    fn end_checkpoint(&mut self, learner: &mut Learner) {
        if let Some(Ended { env_steps, written }) = self.checkpoints.wait(learner) {
            self.tell_of_checkpoint(env_steps, written);
        }
    }

    /// Writes the session's last checkpoint.
    pub fn write_checkpoint(&mut self, learner: &mut Learner) {
        self.begin_checkpoint(learner);
        self.end_checkpoint(learner);
    }

    /// A failure is shown; the previous checkpoint and the training stay.
    fn tell_of_checkpoint(&mut self, env_steps: u64, written: Result<String, CheckpointError>) {
        match written {
            Ok(name) => {
                self.checkpoint_failing = false;
                // A supervisor that is gone is noticed by the loop.
                let _ = self.control.send(&Report::Checkpoint { name, env_steps });
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
        let _ = self.control.send(&Report::Warning { message });
    }

    /// Reports where the learner stands if it is time to.
    pub fn progress(&mut self, learner: &Learner) {
        if self.progress.at.elapsed() >= PROGRESS_INTERVAL {
            self.report_progress(learner);
        }
    }

    /// Reports where the learner stands.
    pub fn report_progress(&mut self, learner: &Learner) {
        let now = Rate::now(learner);
        let (env_steps_per_s, updates_per_s) = self.progress.until(now);
        self.progress = now;
        let counters = learner.counters;
        let _ = self.control.send(&Report::Progress(Progress {
            env_steps: counters.env_steps,
            updates: counters.updates,
            segments: counters.segments,
            env_steps_per_s,
            updates_per_s,
            return_mean: self.return_mean,
            samples_per_insert: learner.samples_per_insert(),
            policy_lag_p50: self.policy_lag.0,
            policy_lag_max: self.policy_lag.1,
            queued_segments: self.control.workers().queued_segments,
            restarts: counters.worker_restarts + counters.learner_restarts,
            rejected: counters.rejected.total(),
            env_failures: counters.env_failures,
        }));
    }
}
