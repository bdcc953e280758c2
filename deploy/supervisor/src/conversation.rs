//! Runs one child outside training, from its start to its answer: an evaluator, an observer or the
//! video process.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_control::{Command, Report};
use dmprl_run::describe;
use dmprl_run::format::shown;
use tokio::sync::mpsc;
use tracing::info;

use super::child::{Child, ChildEvent, EVENTS_MAX, Incoming};
use super::limits::TimeLimits;
use super::logs::log_tail;
use super::process::Process;
use super::signals::interrupts;

/// Reaction to a report of the child.
pub(super) enum Turn<T> {
    /// Ignore the report; the deadline stays.
    Continue,
    /// Wait for the next report, at most for this time.
    Wait(Duration),
    /// Send this command, and wait for the next report, at most for this time.
    Ask(Command, Duration),
    /// The child has answered.
    Done(T),
}

/// A child outside training.
pub(super) struct Conversation {
    /// Name of the child in messages.
    pub who: &'static str,
    /// Log of its standard error.
    pub log: PathBuf,
}

impl Conversation {
    /// Starts the child and passes its reports to `on_report` until it answers; returns `None` if
    /// the user interrupts. Finally kills the child, which has no state to lose.
    ///
    /// # Errors
    /// The child died or took too long, or `on_report` failed.
    pub(super) fn hold<T>(
        &self,
        command: std::process::Command,
        on_report: impl FnMut(Report) -> anyhow::Result<Turn<T>>,
    ) -> anyhow::Result<Option<T>> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .context("cannot start a runtime")?;
        runtime.block_on(async { self.run(command, interrupts()?, on_report).await })
    }

    async fn run<T>(
        &self,
        command: std::process::Command,
        mut interrupts: mpsc::Receiver<()>,
        on_report: impl FnMut(Report) -> anyhow::Result<Turn<T>>,
    ) -> anyhow::Result<Option<T>> {
        let limits = TimeLimits::default();
        let (sender, mut events) = mpsc::channel(EVENTS_MAX);
        let child = Child::spawn(command, Process::Evaluator, sender)?;
        let answer = tokio::select! {
            Some(()) = interrupts.recv() => Ok(None),
            answer = self.answer(&child, &mut events, on_report) => answer.map(Some),
        };
        child.kill();
        let exited = async {
            while let Some(event) = events.recv().await {
                if matches!(event, Incoming::Child(_, ChildEvent::Exited(_))) {
                    return;
                }
            }
        };
        // After an error the child may have exited already.
        if answer.is_ok() {
            tokio::time::timeout(limits.kill, exited).await.with_context(|| {
                format!("{} did not exit within {:?} of SIGKILL", self.who, limits.kill)
            })?;
        }
        answer
    }

    async fn answer<T>(
        &self,
        child: &Child,
        events: &mut mpsc::Receiver<Incoming>,
        mut on_report: impl FnMut(Report) -> anyhow::Result<Turn<T>>,
    ) -> anyhow::Result<T> {
        let mut deadline = Instant::now() + TimeLimits::default().ready;
        let mut expected = "ready";
        loop {
            let Ok(event) = tokio::time::timeout_at(deadline.into(), events.recv()).await else {
                bail!("{} was not {expected} in time{}", self.who, log_tail(&self.log));
            };
            let report = match event {
                Some(Incoming::Child(_, ChildEvent::Report(report))) => report,
                Some(Incoming::Child(_, ChildEvent::Exited(status))) => {
                    bail!("{} died: {}{}", self.who, describe(status), log_tail(&self.log))
                }
                Some(_) => continue,
                None => bail!("{} is gone", self.who),
            };
            show(&report, &self.log);
            let limit = match on_report(report)? {
                Turn::Continue => continue,
                Turn::Done(answer) => return Ok(answer),
                Turn::Wait(limit) => limit,
                Turn::Ask(command, limit) => {
                    child.send(command);
                    limit
                }
            };
            (expected, deadline) = ("done", Instant::now() + limit);
        }
    }

    /// Returns the last lines of the child's log, to be appended to an error.
    pub(super) fn log_tail(&self) -> String {
        log_tail(&self.log)
    }
}

/// Shows warnings and failures to the user.
fn show(report: &Report, log: &Path) {
    match report {
        Report::EnvFailures { last, .. } => {
            info!("environment failure: {last}; log: {}", shown(log));
        }
        Report::Warning { message } | Report::EnvHung { message } => info!("{message}"),
        _ => {}
    }
}
