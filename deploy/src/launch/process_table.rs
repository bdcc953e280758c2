//! What the supervisor knows of its children, written down for whoever watches the run.

use std::time::{Duration, Instant};

use super::Process;
use super::supervisor::{Phase, Running, Slot, Supervisor};
use crate::control::HostNow;
use crate::run_directory::{ProcessRow, ProcessState, Processes};

/// Between two times that the table is written. Workers speak once a second.
const INTERVAL: Duration = Duration::from_secs(2);

impl Supervisor<'_> {
    /// Writes the table when it is due. A run without one is not watched as well, and goes on.
    pub(super) fn tell_processes(&mut self, now: Instant) {
        if self.processes_due.is_none_or(|due| now < due) {
            return;
        }
        self.processes_due = now.checked_add(INTERVAL);
        self.write_processes(false);
    }

    /// Writes the table for the last time: nobody runs any more.
    pub(super) fn tell_end(&mut self) {
        if self.processes_due.is_some() {
            self.write_processes(true);
        }
    }

    fn write_processes(&mut self, ended: bool) {
        let rows = self.slots.iter().map(|(process, slot)| self.row(*process, slot));
        let rows = rows.chain(self.hosts.iter().map(host_row));
        let table = Processes::new(ended, self.started.elapsed().as_secs_f64(), rows.collect());
        if let Err(error) = self.launcher.run.write_processes(&table) {
            self.message(&format!("warning: {error:#}; the run goes on without this file"));
            self.processes_due = None;
        }
    }

    /// Where a child is in its life.
    pub(super) fn process_state(&self, slot: &Slot) -> ProcessState {
        let again = slot.restart_at.is_some() && !matches!(self.phase, Phase::Stopping { .. });
        match &slot.running {
            Some(Running { ready: true, .. }) => ProcessState::Running,
            Some(_) => ProcessState::Starting,
            None if again => ProcessState::Restarting,
            None => ProcessState::Gone,
        }
    }

    fn row(&self, process: Process, slot: &Slot) -> ProcessRow {
        let running = slot.running.as_ref();
        let usage = running.and_then(|running| running.child.id()).map(usage).unwrap_or_default();
        ProcessRow {
            name: process.to_string(),
            joined: self.is_joined(process),
            state: self.process_state(slot),
            doing: running.and_then(|running| running.doing),
            kept_segments: running.map_or(0, |running| running.kept),
            acknowledged_segments: slot.sent.acked,
            starts: slot.starts,
            up_s: running.map(|running| running.spawned.elapsed().as_secs_f64()),
            silent_s: running.map(|running| running.heard.elapsed().as_secs_f64()),
            cpu_s: usage.0,
            memory_bytes: usage.1,
        }
    }
}

/// Another host as a row: what its workers do, all together.
fn host_row(host: &HostNow) -> ProcessRow {
    let state = if host.here { ProcessState::Running } else { ProcessState::Gone };
    ProcessRow {
        name: format!("host {}", host.name.escape_debug()),
        joined: true,
        state,
        doing: None,
        kept_segments: host.kept,
        acknowledged_segments: host.acked,
        starts: 1,
        up_s: None,
        silent_s: None,
        cpu_s: None,
        memory_bytes: None,
    }
}

/// Processor time [s] and memory [bytes] of a process, as far as the system tells.
fn usage(id: u32) -> (Option<f64>, Option<u64>) {
    let read = |name: &str| std::fs::read_to_string(format!("/proc/{id}/{name}")).ok();
    let ticks = rustix::param::clock_ticks_per_second() as f64;
    let cpu_s = read("stat").and_then(|stat| {
        // The name in parentheses may hold anything; utime and stime are fields 14 and 15.
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        let of = |index: usize| fields.get(index)?.parse::<f64>().ok();
        Some((of(11)? + of(12)?) / ticks)
    });
    let page = rustix::param::page_size() as u64;
    let memory = read("statm")
        .and_then(|statm| statm.split_whitespace().nth(1)?.parse::<u64>().ok())
        .map(|pages| pages * page);
    (cpu_s, memory)
}
