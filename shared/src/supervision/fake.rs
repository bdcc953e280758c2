//! A fake supervisor for tests.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::{Activity, Command, Report, ReportError, RunTotals, Supervisor};

/// A supervisor that a test controls. It returns the test's commands, records heartbeats and
/// reports, and can request a stop at a chosen heartbeat or report.
#[derive(Debug, Default)]
pub struct FakeSupervisor {
    /// Requests a stop.
    pub stop: AtomicBool,
    /// Requests that the run end as it does after its last step.
    pub finish: AtomicBool,
    /// Makes every report fail.
    pub gone: AtomicBool,
    stop_after_heartbeats: Option<usize>,
    stop_on: Option<fn(&Report) -> bool>,
    totals: Mutex<RunTotals>,
    commands: Mutex<VecDeque<Command>>,
    heartbeats: Mutex<Vec<Activity>>,
    reports: Mutex<Vec<Report>>,
    unacknowledged: AtomicU64,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl FakeSupervisor {
    /// Creates a supervisor that requests a stop at heartbeat number `count`.
    #[must_use]
    pub fn stopping_after_heartbeats(count: usize) -> Self {
        Self { stop_after_heartbeats: Some(count), ..Self::default() }
    }

    /// Creates a supervisor that requests a stop at the first report that satisfies `predicate`.
    #[must_use]
    pub fn stopping_on(predicate: fn(&Report) -> bool) -> Self {
        Self { stop_on: Some(predicate), ..Self::default() }
    }

    /// Sets the return value of [`Supervisor::totals`].
    pub fn set_totals(&self, totals: RunTotals) {
        *lock(&self.totals) = totals;
    }

    /// Queues a command for the process.
    pub fn command(&self, command: Command) {
        lock(&self.commands).push_back(command);
    }

    /// Returns all heartbeats so far, in order.
    #[must_use]
    pub fn heartbeats(&self) -> Vec<Activity> {
        lock(&self.heartbeats).clone()
    }

    /// Returns all reports so far, in order.
    #[must_use]
    pub fn reports(&self) -> Vec<Report> {
        lock(&self.reports).clone()
    }

    /// Returns the messages of all warnings so far, in order.
    #[must_use]
    pub fn warnings(&self) -> Vec<String> {
        let message = |report: &Report| match report {
            Report::Warning { message } => Some(message.clone()),
            _ => None,
        };
        lock(&self.reports).iter().filter_map(message).collect()
    }

    /// Returns the latest number of unacknowledged segments.
    #[must_use]
    pub fn unacknowledged(&self) -> u64 {
        self.unacknowledged.load(Ordering::Acquire)
    }
}

impl Supervisor for FakeSupervisor {
    fn stop_flag(&self) -> &AtomicBool {
        &self.stop
    }

    fn finish_requested(&self) -> bool {
        self.finish.load(Ordering::Acquire)
    }

    fn is_gone(&self) -> bool {
        self.gone.load(Ordering::Acquire)
    }

    /// Returns at once.
    fn next_command(&self, _wait: Duration) -> Option<Command> {
        lock(&self.commands).pop_front()
    }

    fn totals(&self) -> RunTotals {
        *lock(&self.totals)
    }

    fn heartbeat(&self, doing: Activity) {
        let mut heartbeats = lock(&self.heartbeats);
        heartbeats.push(doing);
        if self.stop_after_heartbeats == Some(heartbeats.len()) {
            self.stop.store(true, Ordering::Release);
        }
    }

    fn note_unacknowledged(&self, segments: usize) {
        self.unacknowledged.store(segments as u64, Ordering::Release);
    }

    fn report(&self, report: &Report) -> Result<(), ReportError> {
        if self.is_gone() {
            return Err(ReportError("the supervisor is gone".into()));
        }
        lock(&self.reports).push(report.clone());
        if self.stop_on.is_some_and(|stops| stops(report)) {
            self.stop.store(true, Ordering::Release);
        }
        Ok(())
    }
}
