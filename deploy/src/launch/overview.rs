//! What each process of a run does, in a few words, for the live display.

use std::time::Instant;

use super::Process;
use super::supervisor::{Running, Slot, Supervisor};
use crate::control::Doing;
use crate::terminal::ProcessLine;

impl Supervisor {
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
