//! What each process of a run does, in a few words, for the live display.

use std::time::{Duration, Instant};

use super::supervisor::{Slot, Supervisor};
use super::{Process, ProcessLine, RunEvent};
use crate::control::{Doing, HostNow};
use crate::run_directory::ProcessState;

/// Between two redraws; a worker gives a sign of life a second, so that each is an occasion.
const REDRAW_EVERY: Duration = Duration::from_millis(500);

impl Supervisor<'_> {
    /// Redraws the live display: what dies, starts or waits is no progress, and is seen all the
    /// same.
    pub(super) fn refresh(&mut self, now: Instant) {
        if self.shows_processes() && now.duration_since(self.drawn) >= REDRAW_EVERY {
            self.drawn = now;
            let processes = self.overview(now);
            self.tell(RunEvent::Processes(processes));
        }
    }

    /// A line for each process, the learner first.
    pub(super) fn overview(&self, now: Instant) -> Vec<ProcessLine> {
        let line = |(process, slot): (&Process, &Slot)| ProcessLine {
            name: process.to_string(),
            state: self.in_words(*process, slot, now),
            restarts: slot.starts.saturating_sub(1),
        };
        self.slots.iter().map(line).collect()
    }

    fn hosts_in_words(&self) -> String {
        if self.hosts.is_empty() {
            return "waiting for other hosts".to_owned();
        }
        let host = |host: &HostNow| {
            let state = match (host.here, host.workers) {
                (false, _) => "out of reach".to_owned(),
                (true, 1) => "1 worker".to_owned(),
                (true, workers) => format!("{workers} workers"),
            };
            format!("{}: {state}", host.name.escape_debug())
        };
        self.hosts.iter().map(host).collect::<Vec<_>>().join(", ")
    }

    fn in_words(&self, process: Process, slot: &Slot, now: Instant) -> String {
        let running = slot.running.as_ref();
        if running.is_some_and(|running| running.killed_for.is_some()) {
            return "killed, to be replaced".into();
        }
        let attached = running.is_some_and(|running| running.attached);
        let words = match (self.process_state(slot), process) {
            (ProcessState::Starting, _) => "starting",
            (ProcessState::Gone, _) => "ended",
            (ProcessState::Restarting, _) => {
                let wait = slot.restart_at.map(|at| at.saturating_duration_since(now));
                let seconds = wait.unwrap_or_default().as_secs_f64().ceil();
                return format!("dead, starts again in {seconds:.0} s");
            }
            (ProcessState::Running, Process::Learner) => "learning",
            (ProcessState::Running, Process::Relay) => "passing segments and policies on",
            (ProcessState::Running, Process::Gateway) => return self.hosts_in_words(),
            (ProcessState::Running, Process::Evaluator) => match self.evaluations.deadline() {
                Some(_) => "evaluating",
                None => "waiting for the next evaluation",
            },
            (ProcessState::Running, Process::Actor(_)) if !attached => "waiting for the learner",
            (ProcessState::Running, Process::Actor(_)) => {
                // Its first sign of life is still to come.
                let doing = running.and_then(|running| running.doing);
                doing.unwrap_or(Doing::Attaching).name()
            }
        };
        words.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::launch::reports::tests::{Unwatched, supervisor};

    #[test]
    fn what_is_dead_says_when_it_comes_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut observer = Unwatched;
        let mut supervisor = supervisor(folder.path(), &mut observer);
        let now = Instant::now();
        let dead =
            Slot { starts: 3, restart_at: Some(now + Duration::from_secs(4)), ..Slot::default() };
        supervisor.slots.insert(Process::Learner, dead);
        supervisor.slots.insert(Process::Actor(1), Slot { starts: 1, ..Slot::default() });
        let lines = supervisor.overview(now);
        let expected = [("learner", "dead, starts again in 4 s", 2), ("actor-1", "ended", 0)];
        for (line, (name, state, restarts)) in lines.iter().zip(expected) {
            assert_eq!((line.name.as_str(), line.state.as_str()), (name, state));
            assert_eq!(line.restarts, restarts);
        }
    }
}
