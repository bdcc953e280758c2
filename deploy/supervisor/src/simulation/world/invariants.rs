//! What holds after every step of the machine, and at the end.

use std::collections::BTreeSet;

use super::{Output, Process, ScheduledEvent, World};
use crate::state::Phase;

impl World {
    pub(super) fn check(&mut self) {
        self.check_needed();
        self.check_children();
        let totals = &self.machine.totals;
        assert_eq!(totals.env_failures, self.model.env_failures, "failures of environments");
        assert_eq!(totals.sent, self.model.sent, "segments");
        if !self.mode.one_process {
            let versions = self.machine.evaluations.versions();
            let requests: Vec<u64> = self.model.requests.iter().copied().collect();
            let outstanding: BTreeSet<u64> = versions.iter().copied().collect();
            assert_eq!(outstanding.len(), versions.len(), "a request is queued twice");
            assert_eq!(outstanding.into_iter().collect::<Vec<_>>(), requests, "evaluations");
        }
        if let Phase::Stopping { .. } = self.machine.phase {
            let limits = &self.machine.settings.limits;
            let latest = self.now + limits.drain.max(limits.stop) + limits.kill;
            let stops_by = *self.model.stops_by.get_or_insert(latest);
            assert!(self.now <= stops_by, "a stop that takes too long: {:#?}", self.machine);
        }
    }

    /// Checks that every process that the run needs is running or has a restart due in time.
    fn check_needed(&self) {
        let machine = &self.machine;
        let hub = machine.settings.hub;
        let needed: Vec<Process> = match machine.phase {
            Phase::Stopping { .. } => Vec::new(),
            Phase::Finishing { .. } if machine.evaluations.outstanding() > 0 => {
                vec![Process::Evaluator]
            }
            Phase::Finishing { .. } => Vec::new(),
            Phase::Draining { .. } => vec![hub, Process::Evaluator],
            Phase::Training => {
                let workers = machine.settings.config.actors.workers as u32;
                let workers = if self.mode.one_process { 0 } else { workers };
                let workers = (0..workers).map(Process::Actor);
                workers.chain([hub, Process::Evaluator, Process::Gateway]).collect()
            }
        };
        for process in needed {
            let Some(slot) = machine.children.slots.get(&process) else {
                assert!(!process.is_worker(), "{process} was never started");
                continue;
            };
            let waits = slot.running.is_none() && slot.restart_at.is_some();
            let is_there = slot.running.is_some() || waits;
            assert!(
                is_there || self.model.given_up.contains(&process),
                "{process} is needed and neither runs nor restarts: {machine:#?}"
            );
            let blocked = process == Process::Learner && machine.learner.waits_for_evaluator;
            if blocked {
                assert!(machine.children.running(Process::Evaluator).is_some(), "{process}");
            } else if let Some(at) = slot.restart_at {
                assert!(machine.next_deadline(self.now) <= at.max(self.now), "{process}");
            }
        }
    }

    /// Checks that machine and world have the same children, apart from exits in flight.
    fn check_children(&self) {
        let learners = self.fakes.keys().filter(|process| **process == Process::Learner);
        assert!(learners.count() <= 1);
        for process in self.fakes.keys() {
            assert!(self.machine.children.running(*process).is_some(), "{process} is unknown");
        }
        for process in self.machine.children.names() {
            let exits = || {
                self.agenda.values().any(|event| match event {
                    ScheduledEvent::Arrival(of, Output::Exit(_) | Output::Gone) => *of == process,
                    _ => false,
                })
            };
            assert!(self.fakes.contains_key(&process) || exits(), "{process} does not exist");
        }
    }

    pub(super) fn check_end(&mut self) {
        let machine = &self.machine;
        if machine.abandoned {
            assert!(self.immortal.is_some(), "abandoned without need");
            self.tally.count("abandoned");
        } else {
            assert!(self.fakes.is_empty(), "left running: {:?}", self.fakes.keys());
        }
        let unanswered = &self.model.requests;
        assert!(self.mode.one_process || unanswered.is_empty(), "unanswered: {unanswered:?}");
        self.tally.count(match (&machine.failure, machine.interrupts) {
            (Some(_), _) => "failed",
            (None, 0) => {
                assert!(machine.learner.finished, "completed, but the learner has not finished");
                "completed"
            }
            (None, _) => "interrupted",
        });
    }
}
