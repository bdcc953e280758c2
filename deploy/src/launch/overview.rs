//! What each process of a run does, in a few words, for the live display.

use std::time::{Duration, Instant};

use super::Process;
use super::supervisor::{Running, Slot, Supervisor};
use crate::control::Doing;
use crate::terminal::ProcessLine;

/// Between two redraws; a worker gives a sign of life a second, so that each is an occasion.
const REDRAW_EVERY: Duration = Duration::from_millis(500);

impl Supervisor {
    /// Redraws the live display: what dies, starts or waits is no progress, and is seen all the
    /// same.
    pub(super) fn refresh(&mut self, now: Instant) {
        if self.display.is_live() && now.duration_since(self.drawn) >= REDRAW_EVERY {
            self.drawn = now;
            let processes = self.overview(now);
            self.display.refresh(&processes);
        }
    }

    /// A line for each process, the learner first.
    pub(super) fn overview(&self, now: Instant) -> Vec<ProcessLine> {
        let line = |(process, slot): (&Process, &Slot)| ProcessLine {
            name: process.to_string(),
            state: match &slot.running {
                Some(running) => self.state(*process, running),
                None => absent(slot, now),
            },
            restarts: slot.starts.saturating_sub(1),
        };
        self.slots.iter().map(line).collect()
    }

    fn state(&self, process: Process, running: &Running) -> String {
        if running.killed_for.is_some() {
            return "killed, to be replaced".into();
        }
        let state = match process {
            _ if !running.ready => "starting",
            Process::Learner => "learning",
            Process::Evaluator if self.evaluations.deadline().is_some() => "evaluating",
            Process::Evaluator => "waiting for the next evaluation",
            Process::Actor(_) if !running.attached => "waiting for the learner",
            // Its first sign of life is still to come.
            Process::Actor(_) => running.doing.unwrap_or(Doing::Attaching).name(),
        };
        state.to_owned()
    }
}

fn absent(slot: &Slot, now: Instant) -> String {
    match slot.restart_at {
        Some(at) => {
            let seconds = at.saturating_duration_since(now).as_secs_f64().ceil();
            format!("dead, starts again in {seconds:.0} s")
        }
        None => "ended".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::launch::reports::tests::supervisor;

    #[test]
    fn what_is_dead_says_when_it_comes_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut supervisor = supervisor(folder.path());
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
