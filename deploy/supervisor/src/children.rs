//! The supervisor's record of its children.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use dmprl_control::Activity;
use dmprl_shared::transport::delivery::Sent;

use super::process::Process;
use super::restart_policy::Death;

/// All processes of the session.
#[derive(Debug, Default)]
pub(super) struct Children {
    pub(super) slots: BTreeMap<Process, Slot>,
}

/// A process of the session, running or not.
#[derive(Debug, Default)]
pub(super) struct Slot {
    pub(super) running: Option<Running>,
    /// Number of starts in this session; each is a new incarnation.
    pub(super) starts: u32,
    /// Restarts since the restart budget was last reset.
    pub(super) restarts: u32,
    pub(super) restart_at: Option<Instant>,
    /// Segments of a worker in this session.
    pub(super) sent: Sent,
}

/// A running process.
#[derive(Debug)]
pub(super) struct Running {
    pub(super) spawned: Instant,
    pub(super) ready: bool,
    /// The worker has received the path of the shared memory, where it also finds a new learner.
    pub(super) attached: bool,
    /// Time of the last report.
    pub(super) heard: Instant,
    /// Activity in the last heartbeat.
    pub(super) activity: Option<Activity>,
    /// Unacknowledged segments in the last heartbeat.
    pub(super) kept: u64,
    pub(super) worked: Option<Worked>,
    /// A worker that had joined has announced that it leaves.
    pub(super) left: bool,
    /// Set if the supervisor killed it.
    pub(super) killed_for: Option<Death>,
    /// Deadline for the exit of a killed process.
    pub(super) ends_by: Option<Instant>,
}

/// Times of the first and the last report of work: a worker's segments, a learner's checkpoints.
#[derive(Debug, Clone, Copy)]
pub(super) struct Worked {
    pub(super) first: Instant,
    pub(super) last: Instant,
}

impl Running {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            spawned: now,
            ready: false,
            attached: false,
            heard: now,
            activity: None,
            kept: 0,
            worked: None,
            left: false,
            killed_for: None,
            ends_by: None,
        }
    }
}

impl Children {
    /// Records a start; returns its number in this session, from 0.
    pub(super) fn start(&mut self, process: Process, now: Instant) -> u32 {
        let slot = self.slots.entry(process).or_default();
        slot.restart_at = None;
        slot.starts += 1;
        slot.running = Some(Running::new(now));
        slot.starts - 1
    }

    /// Whether the process was started in this session.
    pub(super) fn was_started(&self, process: Process) -> bool {
        self.slots.contains_key(&process)
    }

    pub(super) fn running(&self, process: Process) -> Option<&Running> {
        self.slots.get(&process)?.running.as_ref()
    }

    pub(super) fn running_mut(&mut self, process: Process) -> Option<&mut Running> {
        self.slots.get_mut(&process)?.running.as_mut()
    }

    /// Records the exit of a process.
    pub(super) fn take(&mut self, process: Process) -> Option<Running> {
        self.slots.get_mut(&process)?.running.take()
    }

    pub(super) fn all_running(&self) -> impl Iterator<Item = (Process, &Running)> {
        self.slots.iter().filter_map(|(process, slot)| Some((*process, slot.running.as_ref()?)))
    }

    pub(super) fn each_running(&mut self) -> impl Iterator<Item = &mut Running> {
        self.slots.values_mut().filter_map(|slot| slot.running.as_mut())
    }

    /// Names of all running processes.
    pub(super) fn names(&self) -> Vec<Process> {
        self.all_running().map(|(process, _)| process).collect()
    }

    /// Number of attached workers: the run's own and those that have joined.
    pub(super) fn workers(&self) -> usize {
        let attached = self.all_running().filter(|(process, running)| {
            process.is_worker() && running.attached && running.killed_for.is_none()
        });
        attached.count()
    }

    /// Number of workers that run or will be restarted.
    pub(super) fn workers_left(&self) -> usize {
        let remains = |(process, slot): &(&Process, &Slot)| {
            process.is_worker() && (slot.running.is_some() || slot.restart_at.is_some())
        };
        self.slots.iter().filter(remains).count()
    }

    /// Number of unacknowledged segments of all workers.
    pub(super) fn kept(&self) -> u64 {
        self.all_running().map(|(_, running)| running.kept).sum()
    }

    /// Resets a process's restart budget and back-off.
    pub(super) fn reset_restarts(&mut self, process: Process) {
        if let Some(slot) = self.slots.get_mut(&process) {
            slot.restarts = 0;
        }
    }

    /// Records that a process has reported work.
    pub(super) fn worked(&mut self, process: Process, now: Instant) {
        if let Some(running) = self.running_mut(process) {
            let first = running.worked.map_or(now, |worked| worked.first);
            running.worked = Some(Worked { first, last: now });
        }
    }

    /// Cancels the scheduled restarts of the selected processes.
    pub(super) fn cancel_restarts(&mut self, selects: impl Fn(Process) -> bool) {
        let slots = self.slots.iter_mut().filter(|(process, _)| selects(**process));
        slots.for_each(|(_, slot)| slot.restart_at = None);
    }

    /// Measures the silence of every process from `now`.
    pub(super) fn reset_silence(&mut self, now: Instant) {
        self.each_running().for_each(|running| running.heard = now);
    }

    /// Returns the process whose silence will first exceed its limit, and when. `limit` returns
    /// `None` for a process that may be silent. Only ready processes report regularly.
    pub(super) fn first_silent(
        &self,
        limit: impl Fn(Process) -> Option<Duration>,
    ) -> Option<(Instant, Process)> {
        let watched =
            self.all_running().filter(|(_, running)| running.ready && running.killed_for.is_none());
        watched
            .filter_map(|(process, running)| {
                Some((running.heard.checked_add(limit(process)?)?, process))
            })
            .min()
    }
}
