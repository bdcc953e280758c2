//! Tracks active faults, recovery times and progress.

use std::collections::BTreeSet;

use super::violations::Violations;
use crate::journal::{Author, Entry, Record};

/// Maximum time without any segment while all processes are working [us] (I7).
const SILENCE_MAX_US: u64 = 15_000_000;
/// Time limit for the recovery of a killed or suspended worker or learner [us], even on a busy
/// machine.
const RECOVERY_MAX_US: u64 = 90_000_000;
/// Time after the last recovery until work counts as undisturbed [us].
const SETTLE_US: u64 = 500_000;

/// A fault from which the run has not recovered yet.
#[derive(Debug, Clone, Copy)]
struct ActiveFault {
    since_us: u64,
    /// True if the recovery time is measured: after a death, if no other fault affects it.
    measured: bool,
    /// True if a violation has been reported for this fault.
    reported: bool,
}

#[derive(Debug, Default)]
struct Worker {
    fault: Option<ActiveFault>,
    /// The newest incarnation, and the incarnations that the trial has killed.
    incarnation: Option<u32>,
    killed: BTreeSet<u32>,
    /// Number of segments inserted in total, and in undisturbed time.
    inserted: u64,
    undisturbed: u64,
}

/// Faults and recoveries of a run.
pub(super) struct Timeline {
    workers: Vec<Worker>,
    learner_fault: Option<ActiveFault>,
    learner: Option<u64>,
    learners_killed: BTreeSet<u64>,
    /// True once the learner has read its log.
    serving: bool,
    /// Time since which all processes are working.
    all_working_since_us: Option<u64>,
    inserted_us: u64,
    silence_reported: bool,
    /// Times from a death to the first inserted segment [s].
    pub(super) worker_back_s: Vec<f64>,
    pub(super) learner_back_s: Vec<f64>,
    /// Undisturbed time so far [us].
    pub(super) undisturbed_us: u64,
    pub(super) violations: Violations,
}

impl Timeline {
    /// Creates the timeline. Each process counts as faulty until its first segment.
    pub(super) fn new(workers: u32, now_us: u64) -> Self {
        let starting = ActiveFault { since_us: now_us, measured: false, reported: false };
        let worker = || Worker { fault: Some(starting), ..Worker::default() };
        Self {
            workers: (0..workers).map(|_| worker()).collect(),
            learner_fault: Some(starting),
            learner: None,
            learners_killed: BTreeSet::new(),
            serving: false,
            all_working_since_us: None,
            inserted_us: now_us,
            silence_reported: false,
            worker_back_s: Vec::new(),
            learner_back_s: Vec::new(),
            undisturbed_us: 0,
            violations: Violations::default(),
        }
    }

    /// Returns true if a worker has no active fault.
    pub(super) fn is_working(&self, worker: u32) -> bool {
        self.workers.get(worker as usize).is_some_and(|worker| worker.fault.is_none())
    }

    /// Returns true if the learner has no active fault.
    pub(super) fn is_learner_working(&self) -> bool {
        self.learner_fault.is_none()
    }

    /// Returns the time since which all processes have been working, or `None` if one is not.
    pub(super) fn all_working_since_us(&self) -> Option<u64> {
        self.all_working_since_us
    }

    /// Returns the number of inserted segments of each worker.
    pub(super) fn inserted(&self) -> Vec<u64> {
        self.workers.iter().map(|worker| worker.inserted).collect()
    }

    /// Returns the number of segments of each worker inserted in undisturbed time.
    pub(super) fn undisturbed(&self) -> Vec<u64> {
        self.workers.iter().map(|worker| worker.undisturbed).collect()
    }

    /// Records that a worker was killed.
    pub(super) fn worker_killed(&mut self, worker: u32, incarnation: u32, now_us: u64) {
        // While the learner recovers too, the worker's recovery time would include the learner's.
        let measured = self.learner_fault.is_none();
        let Some(worker) = self.workers.get_mut(worker as usize) else { return };
        worker.killed.insert(incarnation);
        worker.fault = Some(ActiveFault { since_us: now_us, measured, reported: false });
        self.end_undisturbed(now_us);
    }

    /// Records that the learner was killed.
    pub(super) fn learner_killed(&mut self, deaths: u64, now_us: u64) {
        self.learners_killed.insert(deaths);
        self.serving = false;
        self.set_learner_fault(ActiveFault { since_us: now_us, measured: true, reported: false });
    }

    /// Records that a worker was suspended or resumed.
    pub(super) fn worker_stopped(&mut self, worker: u32, now_us: u64) {
        if let Some(worker) = self.workers.get_mut(worker as usize) {
            worker.fault = Some(ActiveFault { since_us: now_us, measured: false, reported: false });
        }
        self.end_undisturbed(now_us);
    }

    /// Records that the learner was suspended or resumed.
    pub(super) fn learner_stopped(&mut self, now_us: u64) {
        self.set_learner_fault(ActiveFault { since_us: now_us, measured: false, reported: false });
    }

    fn set_learner_fault(&mut self, fault: ActiveFault) {
        self.learner_fault = Some(fault);
        for fault in self.workers.iter_mut().filter_map(|worker| worker.fault.as_mut()) {
            fault.measured = false;
        }
        self.end_undisturbed(fault.since_us);
    }

    fn end_undisturbed(&mut self, now_us: u64) {
        if let Some(since) = self.all_working_since_us.take() {
            self.undisturbed_us += now_us.saturating_sub(since + SETTLE_US);
        }
    }

    /// Processes a journal record.
    pub(super) fn process(&mut self, author: Author, record: &Record) {
        self.check_predecessors(author);
        match (author, record.entry) {
            (Author::Learner(deaths), Entry::Serving) => {
                self.serving = !self.learners_killed.contains(&deaths);
            }
            (Author::Learner(deaths), Entry::Inserted(segment)) => {
                let alive = !self.learners_killed.contains(&deaths);
                if alive && self.serving {
                    self.on_segment(segment.worker, segment.mark.incarnation, record.time_us);
                }
            }
            _ => {}
        }
    }

    /// Checks that the trial has killed all predecessors of a process.
    fn check_predecessors(&mut self, author: Author) {
        match author {
            Author::Worker(index, incarnation) => {
                let Some(worker) = self.workers.get_mut(index as usize) else { return };
                let before = worker.incarnation.replace(incarnation);
                let dead = before.map_or(0..0, |before| before..incarnation);
                for dead in dead.filter(|dead| !worker.killed.contains(dead)) {
                    self.violations.add(format!(
                        "I7: worker {index}, incarnation {dead}, exited without being killed"
                    ));
                }
            }
            Author::Learner(deaths) => {
                let before = self.learner.replace(deaths);
                let dead = before.map_or(0..0, |before| before..deaths);
                for dead in dead.filter(|dead| !self.learners_killed.contains(dead)) {
                    self.violations.add(format!(
                        "I7: the learner after {dead} deaths exited without being killed"
                    ));
                }
            }
        }
    }

    /// Processes a segment that a live learner inserted from a worker.
    fn on_segment(&mut self, index: u32, incarnation: u32, time_us: u64) {
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
        if self.all_working_since_us.is_some_and(|since| time_us > since + SETTLE_US) {
            worker.undisturbed += 1;
        }
        self.inserted_us = self.inserted_us.max(time_us);
        self.silence_reported = false;
        let all_working = self.workers.iter().all(|worker| worker.fault.is_none());
        if self.all_working_since_us.is_none() && all_working && self.learner_fault.is_none() {
            self.all_working_since_us = Some(time_us);
        }
    }

    /// Checks that no process takes too long to recover, and that segments keep arriving.
    pub(super) fn check_progress(&mut self, now_us: u64) {
        let silence = now_us.saturating_sub(self.inserted_us);
        if self.all_working_since_us.is_some() && silence > SILENCE_MAX_US && !self.silence_reported
        {
            self.silence_reported = true;
            let seconds = silence as f64 / 1e6;
            self.violations
                .add(format!("I7: no segment was inserted for {seconds:.0} s without a fault"));
        }
        let workers = self.workers.iter_mut().enumerate();
        let faults = workers
            .filter_map(|(index, it)| Some((format!("worker {index}"), it.fault.as_mut()?)))
            .chain(self.learner_fault.as_mut().map(|fault| ("the learner".to_owned(), fault)));
        for (name, fault) in faults {
            if now_us.saturating_sub(fault.since_us) > RECOVERY_MAX_US && !fault.reported {
                fault.reported = true;
                let seconds = RECOVERY_MAX_US / 1_000_000;
                self.violations.add(format!("I7: {name} did not recover within {seconds} s"));
            }
        }
    }

    /// Ends the undisturbed time. Must be called before the run is stopped.
    pub(super) fn finish(&mut self, now_us: u64) {
        self.end_undisturbed(now_us);
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::transport::delivery::Watermark;

    use super::*;
    use crate::journal::SegmentDigest;

    const SECOND: u64 = 1_000_000;

    fn inserts(timeline: &mut Timeline, worker: u32, incarnation: u32, time_us: u64) {
        let mark = Watermark { incarnation, sequence: 1 };
        let segment = SegmentDigest { worker, mark, checksum: 0, env_steps: 5 };
        let author = Author::Learner(timeline.learner.unwrap_or(0));
        timeline.process(author, &Record { entry: Entry::Inserted(segment), time_us });
    }

    fn serves(timeline: &mut Timeline, deaths: u64) {
        let record = Record { entry: Entry::Serving, time_us: 0 };
        timeline.process(Author::Learner(deaths), &record);
    }

    /// Returns the timeline of two workers and a learner that have worked since the first second.
    fn working_timeline() -> Timeline {
        let mut timeline = Timeline::new(2, 0);
        serves(&mut timeline, 0);
        inserts(&mut timeline, 0, 0, SECOND - 1);
        assert_eq!(timeline.all_working_since_us(), None);
        inserts(&mut timeline, 1, 0, SECOND);
        assert_eq!(timeline.all_working_since_us(), Some(SECOND));
        timeline
    }

    fn sentences(timeline: Timeline) -> Vec<String> {
        timeline.violations.into_sentences()
    }

    #[test]
    fn killed_worker_recovers_with_its_successors_first_segment() {
        let mut timeline = working_timeline();
        timeline.worker_killed(1, 0, 2 * SECOND);
        // A segment sent before its death.
        inserts(&mut timeline, 1, 0, 3 * SECOND);
        assert!(!timeline.is_working(1) && timeline.all_working_since_us().is_none());
        inserts(&mut timeline, 1, 1, 4 * SECOND);
        assert_eq!(timeline.worker_back_s, [2.0]);
        assert_eq!(timeline.all_working_since_us(), Some(4 * SECOND));
        assert_eq!(timeline.undisturbed_us, SECOND - SETTLE_US);
    }

    /// Segments from its log do not prove that workers can reach it.
    #[test]
    fn killed_learner_recovers_with_a_segment_from_a_worker() {
        let mut timeline = working_timeline();
        timeline.learner_killed(0, 2 * SECOND);
        inserts(&mut timeline, 0, 0, 2 * SECOND + 1);
        timeline.check_predecessors(Author::Learner(1));
        inserts(&mut timeline, 0, 0, 3 * SECOND);
        assert!(!timeline.is_learner_working());
        serves(&mut timeline, 1);
        inserts(&mut timeline, 0, 0, 5 * SECOND);
        assert_eq!(timeline.learner_back_s, [3.0]);
        assert_eq!(sentences(timeline), Vec::<String>::new());
    }

    #[test]
    fn i7_silence_without_a_fault_is_found() {
        let mut timeline = working_timeline();
        timeline.check_progress(SECOND + SILENCE_MAX_US);
        timeline.check_progress(SECOND + SILENCE_MAX_US + 1);
        timeline.check_progress(SECOND + SILENCE_MAX_US + 2);
        let found = sentences(timeline);
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].starts_with("I7: no segment was inserted for 15 s"), "{found:?}");
    }

    #[test]
    fn i7_a_worker_that_does_not_recover_is_found() {
        let mut timeline = working_timeline();
        timeline.worker_killed(1, 0, 2 * SECOND);
        timeline.check_progress(2 * SECOND + RECOVERY_MAX_US + 1);
        assert!(sentences(timeline)[0].starts_with("I7: worker 1 did not recover"));
    }

    #[test]
    fn i7_an_unexpected_exit_is_found() {
        let mut timeline = working_timeline();
        timeline.check_predecessors(Author::Worker(0, 0));
        timeline.worker_killed(0, 0, 2 * SECOND);
        timeline.check_predecessors(Author::Worker(0, 1));
        timeline.check_predecessors(Author::Worker(0, 2));
        timeline.check_predecessors(Author::Learner(1));
        let found = sentences(timeline);
        assert_eq!(found.len(), 2, "{found:?}");
        assert!(found[0].starts_with("I7: worker 0, incarnation 1, exited"), "{found:?}");
        assert!(found[1].starts_with("I7: the learner after 0 deaths exited"), "{found:?}");
    }
}
