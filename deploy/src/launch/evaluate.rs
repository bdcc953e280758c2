//! One evaluation outside training, for `dmprl eval`: an evaluator, one request, one answer.

use std::path::PathBuf;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use tokio::sync::mpsc;

use super::child::{Child, EVENTS_MAX, Event, describe};
use super::deaths::log_tail;
use super::{Launcher, Process, TimeLimits, interrupts};
use crate::control::{Command, EvaluationRequest, EvaluationRow, Report};
use crate::run_directory::RunDirectory;
use crate::terminal::{say, shown};

/// What to evaluate.
pub struct EvaluationPlan<'a> {
    /// The program that plays the evaluator: this one; tests put a fake here.
    pub program: PathBuf,
    /// The run.
    pub run: &'a RunDirectory,
    /// The Python virtual environment.
    pub venv: Option<PathBuf>,
    /// The policy, and where it stood in training.
    pub request: EvaluationRequest,
    /// How many episodes.
    pub episodes: u64,
}

/// Evaluates one saved policy; none when the user interrupted it.
///
/// # Errors
/// The evaluator died or took too long.
pub fn evaluate(plan: EvaluationPlan<'_>) -> anyhow::Result<Option<EvaluationRow>> {
    let launcher = Launcher {
        program: plan.program,
        run: plan.run.clone(),
        venv: plan.venv,
        domain: None,
        resume: false,
        init_from: None,
        learner_restarts: 0,
        sessions_before: 0,
        journal: None,
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start a runtime")?;
    let command = launcher.evaluate(plan.episodes)?;
    let limits = TimeLimits::default();
    let episodes = usize::try_from(plan.episodes).unwrap_or(usize::MAX);
    let evaluation = Evaluation {
        request: plan.request,
        ready: limits.ready,
        answer: limits.evaluation_of(episodes),
        kill: limits.kill,
        log: plan.run.log_path("eval"),
    };
    runtime.block_on(async { evaluation.run(command, interrupts()?).await })
}

struct Evaluation {
    request: EvaluationRequest,
    ready: Duration,
    answer: Duration,
    kill: Duration,
    log: PathBuf,
}

impl Evaluation {
    async fn run(
        self,
        command: std::process::Command,
        mut interrupts: mpsc::Receiver<()>,
    ) -> anyhow::Result<Option<EvaluationRow>> {
        let (sender, mut events) = mpsc::channel(EVENTS_MAX);
        let child = Child::spawn(command, Process::Evaluator, sender)?;
        let answer = tokio::select! {
            // It holds nothing that a kill could damage.
            Some(()) = interrupts.recv() => Ok(None),
            answer = self.answer(&child, &mut events) => answer.map(Some),
        };
        child.kill();
        let exited = async {
            while let Some(event) = events.recv().await {
                if matches!(event, Event::Exited(..)) {
                    return;
                }
            }
        };
        // An evaluator that has exited already has no second exit to wait for.
        if answer.is_ok() {
            tokio::time::timeout(self.kill, exited).await.with_context(|| {
                format!("the evaluator did not end {:?} after SIGKILL", self.kill)
            })?;
        }
        answer
    }

    async fn answer(
        &self,
        child: &Child,
        events: &mut mpsc::Receiver<Event>,
    ) -> anyhow::Result<EvaluationRow> {
        let mut deadline = Instant::now() + self.ready;
        let mut waiting_for = "ready";
        loop {
            let Ok(event) = tokio::time::timeout_at(deadline.into(), events.recv()).await else {
                bail!("the evaluator was not {waiting_for} in time{}", log_tail(&self.log));
            };
            match event {
                Some(Event::Report(_, Report::EnvironmentReady { .. })) => {
                    child.send(Command::Evaluate(self.request.clone()));
                    deadline = Instant::now() + self.answer;
                    waiting_for = "done";
                }
                Some(Event::Report(_, Report::Evaluated(row))) => return Ok(row),
                Some(Event::Report(_, Report::NotEvaluated { reason, .. })) => {
                    bail!("the evaluation failed: {reason}{}", log_tail(&self.log));
                }
                Some(Event::Report(_, Report::EnvFailures { last, .. })) => {
                    say(&format!("environment failure: {last}; log: {}", shown(&self.log)));
                }
                Some(Event::Report(
                    _,
                    Report::Warning { message } | Report::EnvHung { message },
                )) => say(&message),
                Some(Event::Report(..) | Event::Garbage(..)) => {}
                // Nobody joins an evaluation.
                Some(Event::Asked(_) | Event::Gone(_)) => {}
                Some(Event::Exited(_, status)) => bail!("{}", self.died(status)),
                None => bail!("the evaluator is gone"),
            }
        }
    }

    fn died(&self, status: ExitStatus) -> String {
        format!("the evaluator died: {}{}", describe(status), log_tail(&self.log))
    }
}
