//! Read-only views of the state: lines for the live display, rows for `processes.json`.

use std::time::Instant;

use dmprl_control::{Activity, HostNow};
use dmprl_run::{ProcessRow, ProcessState};

use super::children::{Running, Slot};
use super::machine::Machine;
use super::observer::ProcessLine;
use super::process::Process;
use super::state::Phase;

/// Formats a line for each process, the learner first.
pub(super) fn process_lines(machine: &Machine, now: Instant) -> Vec<ProcessLine> {
    let line = |(process, slot): (&Process, &Slot)| ProcessLine {
        name: process.to_string(),
        state: describe(machine, *process, slot, now),
        restarts: slot.starts.saturating_sub(1),
    };
    machine.children.slots.iter().map(line).collect()
}

fn describe(machine: &Machine, process: Process, slot: &Slot, now: Instant) -> String {
    let running = slot.running.as_ref();
    if running.is_some_and(|running| running.killed_for.is_some()) {
        return "killed, exiting".into();
    }
    let attached = running.is_some_and(|running| running.attached);
    let words = match (process_state(machine, slot), process) {
        (ProcessState::Starting, _) => "starting",
        (ProcessState::Gone, _) => "ended",
        (ProcessState::Restarting, _) => {
            let wait = slot.restart_at.map(|at| at.saturating_duration_since(now));
            let seconds = wait.unwrap_or_default().as_secs_f64().ceil();
            return format!("dead, restarts in {seconds:.0} s");
        }
        (ProcessState::Running, Process::Learner) => "learning",
        (ProcessState::Running, Process::Relay) => "forwarding segments and policies",
        (ProcessState::Running, Process::Gateway) => return machine.hosts.description(),
        (ProcessState::Running, Process::Evaluator) => match machine.evaluations.deadline() {
            Some(_) => "evaluating",
            None => "waiting for the next evaluation",
        },
        (ProcessState::Running, Process::Actor(_)) if !attached => "waiting for the learner",
        (ProcessState::Running, Process::Actor(_)) => {
            // It attaches before its first heartbeat.
            running.and_then(|running| running.activity).unwrap_or(Activity::Attaching).name()
        }
    };
    words.to_owned()
}

fn process_state(machine: &Machine, slot: &Slot) -> ProcessState {
    let restarts = slot.restart_at.is_some() && !matches!(machine.phase, Phase::Stopping { .. });
    match &slot.running {
        Some(Running { ready: true, .. }) => ProcessState::Running,
        Some(_) => ProcessState::Starting,
        None if restarts => ProcessState::Restarting,
        None => ProcessState::Gone,
    }
}

/// Processor time and memory of a process, as far as the system reports them.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Usage {
    pub(super) cpu_s: Option<f64>,
    pub(super) memory_bytes: Option<u64>,
}

/// Creates a row for each process and each other host.
pub(super) fn process_rows(
    machine: &Machine,
    usage: impl Fn(Process) -> Usage,
    now: Instant,
) -> Vec<ProcessRow> {
    let seconds_since = |then: Instant| now.saturating_duration_since(then).as_secs_f64();
    let row = |(process, slot): (&Process, &Slot)| {
        let running = slot.running.as_ref();
        let Usage { cpu_s, memory_bytes } = usage(*process);
        ProcessRow {
            name: process.to_string(),
            joined: machine.is_joined(*process),
            state: process_state(machine, slot),
            doing: running.and_then(|running| running.activity),
            kept_segments: running.map_or(0, |running| running.kept),
            acknowledged_segments: slot.sent.acked,
            starts: slot.starts,
            up_s: running.map(|running| seconds_since(running.spawned)),
            silent_s: running.map(|running| seconds_since(running.heard)),
            cpu_s,
            memory_bytes,
        }
    };
    let rows = machine.children.slots.iter().map(row);
    rows.chain(machine.hosts.0.iter().map(host_row)).collect()
}

/// Creates one row for all workers of another host.
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

/// Reads processor time and memory of a process from /proc.
pub(super) fn usage_of(id: u32) -> Usage {
    let read = |name: &str| std::fs::read_to_string(format!("/proc/{id}/{name}")).ok();
    let ticks = rustix::param::clock_ticks_per_second() as f64;
    let cpu_s = read("stat").and_then(|stat| {
        // The name in parentheses may contain anything; utime and stime are fields 14 and 15.
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        let of = |index: usize| fields.get(index)?.parse::<f64>().ok();
        Some((of(11)? + of(12)?) / ticks)
    });
    let page = rustix::param::page_size() as u64;
    let memory_bytes = read("statm")
        .and_then(|statm| statm.split_whitespace().nth(1)?.parse::<u64>().ok())
        .map(|pages| pages * page);
    Usage { cpu_s, memory_bytes }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::machine::tests::machine;

    #[test]
    fn a_dead_process_shows_the_time_until_its_restart() {
        let folder = tempfile::tempdir().unwrap();
        let now = Instant::now();
        let mut machine = machine(folder.path(), now);
        let dead =
            Slot { starts: 3, restart_at: Some(now + Duration::from_secs(4)), ..Slot::default() };
        machine.children.slots.insert(Process::Learner, dead);
        machine.children.slots.insert(Process::Actor(1), Slot { starts: 1, ..Slot::default() });
        let lines = process_lines(&machine, now);
        let expected = [("learner", "dead, restarts in 4 s", 2), ("actor-1", "ended", 0)];
        for (line, (name, state, restarts)) in lines.iter().zip(expected) {
            assert_eq!((line.name.as_str(), line.state.as_str()), (name, state));
            assert_eq!(line.restarts, restarts);
        }
    }
}
