//! Tracks active faults, recovery times, and progress.

use std::collections::BTreeSet;

use super::violations::Violations;
use crate::journal::{Author, Entry, Record};

/// Maximum time without any segment while all processes are working [us] (I7).
const SILENCE_MAX_US: u64 = 15_000_000;
/// Time limit for the return of a killed or suspended worker or learner [us], even on a busy
/// machine.
const BACK_MAX_US: u64 = 90_000_000;
/// Time after the last recovery from which work counts as undisturbed [us].
const SETTLE_US: u64 = 500_000;

/// A fault from which the run has not recovered yet.
#[derive(Debug, Clone, Copy)]
struct Fault {
    since_us: u64,
    /// True if it is a death, and no other fault has occurred since.
    measured: bool,
    /// True if a violation has been reported for it.
    told: bool,
}

#[derive(Debug, Default)]
struct Worker {
    fault: Option<Fault>,
    /// The newest incarnation seen, and the incarnations that were killed.
    incarnation: Option<u32>,
    killed: BTreeSet<u32>,
    /// Segments inserted in total, and in undisturbed time.
    inserted: u64,
    undisturbed: u64,
}

/// Faults and recovery of a run.
pub(super) struct Timeline {
    workers: Vec<Worker>,
    learner_fault: Option<Fault>,
    learner: Option<u64>,
    learners_killed: BTreeSet<u64>,
    /// True once the learner has read its log.
    serving: bool,
    /// Time since which all processes are working.
    clear_since_us: Option<u64>,
    inserted_us: u64,
    silence_told: bool,
    /// Times from a death to the first segment [s].
    pub(super) worker_back_s: Vec<f64>,
    pub(super) learner_back_s: Vec<f64>,
    /// Undisturbed time so far [us].
    pub(super) undisturbed_us: u64,
    pub(super) violations: Violations,
}

impl Timeline {
    /// Creates the timeline. Each process counts as missing until its first segment.
    pub(super) fn new(workers: u32, now_us: u64) -> Self {
        let missing = Fault { since_us: now_us, measured: false, told: false };
        let worker = || Worker { fault: Some(missing), ..Worker::default() };
        Self {
            workers: (0..workers).map(|_| worker()).collect(),
            learner_fault: Some(missing),
            learner: None,
            learners_killed: BTreeSet::new(),
            serving: false,
            clear_since_us: None,
            inserted_us: now_us,
            silence_told: false,
            worker_back_s: Vec::new(),
            learner_back_s: Vec::new(),
            undisturbed_us: 0,
            violations: Violations::default(),
        }
    }

    /// Returns true if a worker is working, as far as known.
    pub(super) fn is_back(&self, worker: u32) -> bool {
        self.workers.get(worker as usize).is_some_and(|worker| worker.fault.is_none())
    }

    /// Returns true if the learner is working.
    pub(super) fn is_learner_back(&self) -> bool {
        self.learner_fault.is_none()
    }

    /// Time since which all processes are working; `None` if one is not.
    pub(super) fn clear_since_us(&self) -> Option<u64> {
        self.clear_since_us
    }

    /// Number of segments of each worker so far.
    pub(super) fn inserted(&self) -> Vec<u64> {
        self.workers.iter().map(|worker| worker.inserted).collect()
    }

    /// Number of segments of each worker in undisturbed time.
    pub(super) fn undisturbed(&self) -> Vec<u64> {
        self.workers.iter().map(|worker| worker.undisturbed).collect()
    }

    /// Records that a worker is killed.
    pub(super) fn worker_killed(&mut self, worker: u32, incarnation: u32, now_us: u64) {
        // Otherwise its return would also depend on the learner's.
        let measured = self.learner_fault.is_none();
        let Some(worker) = self.workers.get_mut(worker as usize) else { return };
        worker.killed.insert(incarnation);
        worker.fault = Some(Fault { since_us: now_us, measured, told: false });
        self.disturb(now_us);
    }

    /// Records that the learner is killed.
    pub(super) fn learner_killed(&mut self, deaths: u64, now_us: u64) {
        self.learners_killed.insert(deaths);
        self.serving = false;
        self.break_learner(Fault { since_us: now_us, measured: true, told: false });
    }

    /// Records that a worker is suspended, or was until now.
    pub(super) fn worker_stopped(&mut self, worker: u32, now_us: u64) {
        if let Some(worker) = self.workers.get_mut(worker as usize) {
            worker.fault = Some(Fault { since_us: now_us, measured: false, told: false });
        }
        self.disturb(now_us);
    }

    /// Records that the learner is suspended, or was until now.
    pub(super) fn learner_stopped(&mut self, now_us: u64) {
        self.break_learner(Fault { since_us: now_us, measured: false, told: false });
    }

    fn break_learner(&mut self, fault: Fault) {
        self.learner_fault = Some(fault);
        for fault in self.workers.iter_mut().filter_map(|worker| worker.fault.as_mut()) {
            fault.measured = false;
        }
        self.disturb(fault.since_us);
    }

    fn disturb(&mut self, now_us: u64) {
        if let Some(since) = self.clear_since_us.take() {
            self.undisturbed_us += now_us.saturating_sub(since + SETTLE_US);
        }
    }

    /// Processes a journal record.
    pub(super) fn take(&mut self, author: Author, record: &Record) {
        self.meet(author);
        match (author, record.entry) {
            (Author::Learner(deaths), Entry::Serving) => {
                self.serving = !self.learners_killed.contains(&deaths);
            }
            (Author::Learner(deaths), Entry::Inserted(piece)) => {
                let alive = !self.learners_killed.contains(&deaths);
                let worker = (piece.worker, piece.mark.incarnation);
                if alive && self.serving {
                    self.on_segment(worker, record.time_us);
                }
            }
            _ => {}
        }
    }

    /// Notices a new process, whose predecessor must have been killed by the trial.
    fn meet(&mut self, author: Author) {
        match author {
            Author::Worker(index, incarnation) => {
                let Some(worker) = self.workers.get_mut(index as usize) else { return };
                let before = worker.incarnation.replace(incarnation);
                let dead = before.map_or(0..0, |before| before..incarnation);
                for dead in dead.filter(|dead| !worker.killed.contains(dead)) {
                    self.violations.add(format!(
                        "I7: worker {index}, incarnation {dead}, has ended without being killed"
                    ));
                }
            }
            Author::Learner(deaths) => {
                let before = self.learner.replace(deaths);
                let dead = before.map_or(0..0, |before| before..deaths);
                for dead in dead.filter(|dead| !self.learners_killed.contains(dead)) {
                    self.violations.add(format!(
                        "I7: the learner after {dead} deaths has ended without being killed"
                    ));
                }
            }
        }
    }

    fn on_segment(&mut self, (index, incarnation): (u32, u32), time_us: u64) {
        let seconds = |since: u64| time_us.saturating_sub(since) as f64 / 1e6;
        if let Some(fault) = self.learner_fault.filter(|fault| time_us > fault.since_us) {
            self.learner_fault = None;
            if fault.measured {
                self.learner_back_s.push(seconds(fault.since_us));
            }
        }
        let Some(worker) = self.workers.get_mut(index as usize) else { return };
        worker.inserted += 1;
        let alive = !worker.killed.contains(&incarnation);
        if let Some(fault) = worker.fault.filter(|it| alive && time_us > it.since_us) {
            worker.fault = None;
            if fault.measured {
                self.worker_back_s.push(seconds(fault.since_us));
            }
        }
        if self.clear_since_us.is_some_and(|since| time_us > since + SETTLE_US) {
            worker.undisturbed += 1;
        }
        self.inserted_us = self.inserted_us.max(time_us);
        self.silence_told = false;
        let all_back = self.workers.iter().all(|worker| worker.fault.is_none());
        if self.clear_since_us.is_none() && all_back && self.learner_fault.is_none() {
            self.clear_since_us = Some(time_us);
        }
    }

    /// Checks whether a process has been missing, or all have been silent, for too long.
    pub(super) fn look(&mut self, now_us: u64) {
        let silence = now_us.saturating_sub(self.inserted_us);
        if self.clear_since_us.is_some() && silence > SILENCE_MAX_US && !self.silence_told {
            self.silence_told = true;
            let seconds = silence as f64 / 1e6;
            self.violations
                .add(format!("I7: nothing was inserted for {seconds:.0} s without a fault"));
        }
        let workers = self.workers.iter_mut().enumerate();
        let faults = workers
            .filter_map(|(index, it)| Some((format!("worker {index}"), it.fault.as_mut()?)))
            .chain(self.learner_fault.as_mut().map(|fault| ("the learner".to_owned(), fault)));
        for (name, fault) in faults {
            if now_us.saturating_sub(fault.since_us) > BACK_MAX_US && !fault.told {
                fault.told = true;
                let seconds = BACK_MAX_US / 1_000_000;
                self.violations
                    .add(format!("I7: {name} was not back {seconds} s after the last fault"));
            }
        }
    }

    /// Ends the undisturbed time, before the run is stopped.
    pub(super) fn close(&mut self, now_us: u64) {
        self.disturb(now_us);
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::transport::delivery::Watermark;

    use super::*;
    use crate::journal::Piece;

    const SECOND: u64 = 1_000_000;

    fn inserts(timeline: &mut Timeline, worker: u32, incarnation: u32, time_us: u64) {
        let mark = Watermark { incarnation, sequence: 1 };
        let piece = Piece { worker, mark, checksum: 0, env_steps: 5 };
        let author = Author::Learner(timeline.learner.unwrap_or(0));
        timeline.take(author, &Record { entry: Entry::Inserted(piece), time_us });
    }

    fn serves(timeline: &mut Timeline, deaths: u64) {
        let record = Record { entry: Entry::Serving, time_us: 0 };
        timeline.take(Author::Learner(deaths), &record);
    }

    /// Two workers and a learner, which have been working since the first second.
    fn at_work() -> Timeline {
        let mut timeline = Timeline::new(2, 0);
        serves(&mut timeline, 0);
        inserts(&mut timeline, 0, 0, SECOND - 1);
        assert_eq!(timeline.clear_since_us(), None);
        inserts(&mut timeline, 1, 0, SECOND);
        assert_eq!(timeline.clear_since_us(), Some(SECOND));
        timeline
    }

    fn sentences(timeline: Timeline) -> Vec<String> {
        timeline.violations.into_sentences()
    }

    #[test]
    fn a_killed_worker_is_back_with_its_successors_first_segment() {
        let mut timeline = at_work();
        timeline.worker_killed(1, 0, 2 * SECOND);
        // A segment sent before its death.
        inserts(&mut timeline, 1, 0, 3 * SECOND);
        assert!(!timeline.is_back(1) && timeline.clear_since_us().is_none());
        inserts(&mut timeline, 1, 1, 4 * SECOND);
        assert_eq!(timeline.worker_back_s, [2.0]);
        assert_eq!(timeline.clear_since_us(), Some(4 * SECOND));
        assert_eq!(timeline.undisturbed_us, SECOND - SETTLE_US);
    }

    /// Segments from its log do not prove that workers reach it.
    #[test]
    fn a_killed_learner_is_back_with_a_segment_from_a_worker() {
        let mut timeline = at_work();
        timeline.learner_killed(0, 2 * SECOND);
        inserts(&mut timeline, 0, 0, 2 * SECOND + 1);
        timeline.meet(Author::Learner(1));
        inserts(&mut timeline, 0, 0, 3 * SECOND);
        assert!(!timeline.is_learner_back());
        serves(&mut timeline, 1);
        inserts(&mut timeline, 0, 0, 5 * SECOND);
        assert_eq!(timeline.learner_back_s, [3.0]);
        assert_eq!(sentences(timeline), Vec::<String>::new());
    }

    #[test]
    fn i7_silence_while_nothing_is_broken_is_found() {
        let mut timeline = at_work();
        timeline.look(SECOND + SILENCE_MAX_US);
        timeline.look(SECOND + SILENCE_MAX_US + 1);
        timeline.look(SECOND + SILENCE_MAX_US + 2);
        let found = sentences(timeline);
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].starts_with("I7: nothing was inserted for 15 s"), "{found:?}");
    }

    #[test]
    fn i7_a_worker_that_does_not_come_back_is_found() {
        let mut timeline = at_work();
        timeline.worker_killed(1, 0, 2 * SECOND);
        timeline.look(2 * SECOND + BACK_MAX_US + 1);
        assert!(sentences(timeline)[0].starts_with("I7: worker 1 was not back"));
    }

    #[test]
    fn i7_a_death_that_nobody_caused_is_found() {
        let mut timeline = at_work();
        timeline.meet(Author::Worker(0, 0));
        timeline.worker_killed(0, 0, 2 * SECOND);
        timeline.meet(Author::Worker(0, 1));
        timeline.meet(Author::Worker(0, 2));
        timeline.meet(Author::Learner(1));
        let found = sentences(timeline);
        assert_eq!(found.len(), 2, "{found:?}");
        assert!(found[0].starts_with("I7: worker 0, incarnation 1, has ended"), "{found:?}");
        assert!(found[1].starts_with("I7: the learner after 0 deaths has ended"), "{found:?}");
    }
}
