//! One child outside training, from its start to its answer: for `dmprl eval` and whoever observes.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use tokio::sync::mpsc;

use super::child::{Child, EVENTS_MAX, Event, describe};
use super::deaths::log_tail;
use super::{Process, TimeLimits, interrupts};
use crate::control::{Command, Report};
use crate::terminal::{say, shown};

/// What a report of the child means.
pub(super) enum Turn<T> {
    /// Nothing for this conversation.
    GoOn,
    /// It is on its way: what comes next may take so long.
    Wait(&'static str, Duration),
    /// Send this, whose answer may take so long.
    Ask(Command, &'static str, Duration),
    /// It has answered.
    Over(T),
}

/// Whom one speaks with.
pub(super) struct Conversation {
    /// As the subject of a sentence.
    pub who: &'static str,
    /// Its standard error.
    pub log: PathBuf,
}

impl Conversation {
    /// Starts the child and lets `hear` answer its reports; none when the user interrupted it. In
    /// either case the child is killed: it holds nothing that this could damage.
    ///
    /// # Errors
    /// It died, took too long, or `hear` refuses.
    pub(super) fn hold<T>(
        &self,
        command: std::process::Command,
        hear: impl FnMut(Report) -> anyhow::Result<Turn<T>>,
    ) -> anyhow::Result<Option<T>> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .context("cannot start a runtime")?;
        runtime.block_on(async { self.run(command, interrupts()?, hear).await })
    }

    async fn run<T>(
        &self,
        command: std::process::Command,
        mut interrupts: mpsc::Receiver<()>,
        hear: impl FnMut(Report) -> anyhow::Result<Turn<T>>,
    ) -> anyhow::Result<Option<T>> {
        let limits = TimeLimits::default();
        let (sender, mut events) = mpsc::channel(EVENTS_MAX);
        let child = Child::spawn(command, Process::Evaluator, sender)?;
        let answer = tokio::select! {
            Some(()) = interrupts.recv() => Ok(None),
            answer = self.answer(&child, &mut events, (limits.ready, hear)) => answer.map(Some),
        };
        child.kill();
        let exited = async {
            while let Some(event) = events.recv().await {
                if matches!(event, Event::Exited(..)) {
                    return;
                }
            }
        };
        // One that has exited already has no second exit to wait for.
        if answer.is_ok() {
            tokio::time::timeout(limits.kill, exited).await.with_context(|| {
                format!("{} did not end {:?} after SIGKILL", self.who, limits.kill)
            })?;
        }
        answer
    }

    async fn answer<T>(
        &self,
        child: &Child,
        events: &mut mpsc::Receiver<Event>,
        (ready, mut hear): (Duration, impl FnMut(Report) -> anyhow::Result<Turn<T>>),
    ) -> anyhow::Result<T> {
        let mut deadline = Instant::now() + ready;
        let mut waiting_for = "ready";
        loop {
            let Ok(event) = tokio::time::timeout_at(deadline.into(), events.recv()).await else {
                bail!("{} was not {waiting_for} in time{}", self.who, log_tail(&self.log));
            };
            let report = match event {
                Some(Event::Report(_, report)) => report,
                Some(Event::Garbage(..)) => continue,
                // Nobody joins such a child.
                Some(Event::Asked(_) | Event::Gone(_)) => continue,
                Some(Event::Exited(_, status)) => {
                    bail!("{} died: {}{}", self.who, describe(status), log_tail(&self.log))
                }
                None => bail!("{} is gone", self.who),
            };
            tell(&report, &self.log);
            let (what, limit) = match hear(report)? {
                Turn::GoOn => continue,
                Turn::Over(answer) => return Ok(answer),
                Turn::Wait(what, limit) => (what, limit),
                Turn::Ask(command, what, limit) => {
                    child.send(command);
                    (what, limit)
                }
            };
            (waiting_for, deadline) = (what, Instant::now() + limit);
        }
    }

    /// The last lines of its log, to end an error with.
    pub(super) fn log_tail(&self) -> String {
        log_tail(&self.log)
    }
}

/// What the user should read, whatever the conversation is about.
fn tell(report: &Report, log: &Path) {
    match report {
        Report::EnvFailures { last, .. } => {
            say(&format!("environment failure: {last}; log: {}", shown(log)));
        }
        Report::Warning { message } | Report::EnvHung { message } => say(message),
        _ => {}
    }
}
