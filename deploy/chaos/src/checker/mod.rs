//! Verifies from the journals that no segment is lost, duplicated or corrupted, and that counters
//! and policies never go backwards.
//!
//! A learner's *lineage* consists of the segments in its checkpoint, those from its log, and those
//! it has inserted since. The marks of its checkpoint say how much of its predecessor's lineage a
//! starting learner has kept; the log and the workers restore the rest. The checker stores four
//! bytes per segment: the worker's checksum. It stores the inserted segments as the highest
//! sequence number and the gaps below it.

mod incarnation;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use dmprl_shared::transport::delivery::Watermark;
use incarnation::IncarnationState;

use super::violations::Violations;
use crate::journal::{Author, Entry, LearnerCounters, Record, SegmentDigest};

/// Maximum distance between checkpoints, in intervals. While a checkpoint is being written, the
/// next one is delayed.
const INTERVALS_MAX: u64 = 2;
/// Upper bound on the environment steps in a segment, by which the distance may be exceeded.
const SEGMENT_STEPS: u64 = 100;

/// Total numbers of segments by outcome.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct SegmentTotals {
    /// Finished by workers.
    pub(super) produced: u64,
    /// In the last learner's lineage.
    pub(super) inserted: u64,
    /// Rejected permanently, except duplicates.
    pub(super) rejected: u64,
    /// Never sent or never received, because the worker was killed or stopped.
    pub(super) in_flight: u64,
    /// Missing although acknowledged, or although later segments of the same worker arrived.
    pub(super) lost: u64,
    /// Rejected as duplicates after a retransmit.
    pub(super) duplicate: u64,
    /// Acknowledged to workers.
    pub(super) acknowledged: u64,
}

/// Checks a run by its journals.
pub(super) struct Checker {
    /// State of each worker's incarnations, by number.
    incarnations: Vec<BTreeMap<u32, IncarnationState>>,
    /// Last segment of each worker in the lineage.
    settled: Vec<Watermark>,
    /// Counters of the newest learner.
    counters: LearnerCounters,
    /// Counters at the start of the run and of each checkpoint begun since, except those that a
    /// later learner has rolled back.
    checkpoint_counters: Vec<LearnerCounters>,
    /// Environment steps since the last checkpoint was begun or the learner started to serve.
    /// `None` while a learner reads its log, which no checkpoint interrupts.
    steps_since_checkpoint: Option<u64>,
    checkpoint_interval: u64,
    /// Epoch of each worker's newest policy.
    epochs: Vec<u64>,
    duplicate: u64,
    checkpoints: u64,
    pub(super) violations: Violations,
}

impl Checker {
    pub(super) fn new(workers: u32, checkpoint_interval: u64) -> Self {
        let count = workers as usize;
        Self {
            incarnations: vec![BTreeMap::new(); count],
            settled: vec![Watermark::default(); count],
            counters: LearnerCounters::default(),
            checkpoint_counters: vec![LearnerCounters::default()],
            steps_since_checkpoint: None,
            checkpoint_interval,
            epochs: vec![0; count],
            duplicate: 0,
            checkpoints: 0,
            violations: Violations::default(),
        }
    }

    /// Processes a record. An author's records must come in order, and a learner's records after
    /// all earlier records of the workers.
    pub(super) fn process(&mut self, author: Author, record: &Record) {
        match (author, record.entry) {
            (Author::Worker(worker, incarnation), entry) => {
                if worker as usize >= self.incarnations.len() {
                    self.violations.add(format!("I9: journal of unknown worker {worker}"));
                } else {
                    self.on_worker(worker, incarnation, entry);
                }
            }
            (Author::Learner(_), Entry::Restored(worker, mark)) => self.on_restored(worker, mark),
            (Author::Learner(deaths), Entry::Started(counters)) => {
                self.on_started(deaths, counters);
            }
            (Author::Learner(_), Entry::Serving) => self.steps_since_checkpoint = Some(0),
            (Author::Learner(_), Entry::Inserted(segment)) => self.on_inserted(&segment),
            (Author::Learner(_), Entry::Rejected { is_duplicate: true, .. }) => self.duplicate += 1,
            (Author::Learner(_), Entry::Rejected { segment, is_duplicate: false }) => {
                self.on_rejected(&segment);
            }
            (Author::Learner(_), Entry::CheckpointBegun(counters)) => {
                self.checkpoint_counters.push(counters);
                self.checkpoints += 1;
                self.steps_since_checkpoint = Some(0);
            }
            (author, entry) => {
                self.violations
                    .add(format!("I9: unexpected {entry:?} in the journal of {author:?}"));
            }
        }
    }

    /// Returns the newest learner's counters.
    pub(super) fn counters(&self) -> LearnerCounters {
        self.counters
    }

    /// Returns the newest learner's last segment of each worker.
    pub(super) fn settled(&self) -> &[Watermark] {
        &self.settled
    }

    /// Returns the number of checkpoints begun.
    pub(super) fn checkpoints(&self) -> u64 {
        self.checkpoints
    }

    fn on_worker(&mut self, worker: u32, incarnation: u32, entry: Entry) {
        let state = self.incarnations[worker as usize].entry(incarnation).or_default();
        let name = format!("worker {worker}, incarnation {incarnation}");
        match entry {
            Entry::Produced(segment) => {
                let expected = Watermark { incarnation, sequence: state.produced.len() as u64 + 1 };
                state.produced.push(segment.checksum);
                if (segment.worker, segment.mark) != (worker, expected) {
                    self.violations.add(format!(
                        "I9: {name}, produced segment {} after {}",
                        segment.mark.sequence,
                        expected.sequence - 1
                    ));
                }
            }
            Entry::Acknowledged(mark) => {
                if mark.sequence < state.acked || mark.sequence > state.produced.len() as u64 {
                    self.violations.add(format!(
                        "I1: {name}: {} acknowledged after {}, with {} produced",
                        mark.sequence,
                        state.acked,
                        state.produced.len()
                    ));
                }
                state.acked = state.acked.max(mark.sequence);
            }
            Entry::Policy { epoch, version } => {
                let newest = &mut self.epochs[worker as usize];
                if epoch < *newest {
                    let text = format!("I6: {name}, went from epoch {newest} to {epoch}");
                    self.violations.add(text);
                }
                *newest = epoch.max(*newest);
                let (epoch_before, before) = state.policy;
                if epoch == epoch_before && version < before {
                    self.violations.add(format!(
                        "I6: {name}, went from policy {before} to {version} in epoch {epoch}"
                    ));
                }
                state.policy = (epoch, version);
            }
            entry => {
                self.violations.add(format!("I9: unexpected {entry:?} in the journal of {name}"));
            }
        }
    }

    /// Rolls the lineage back to a worker's mark in a checkpoint.
    fn on_restored(&mut self, worker: u32, mark: Watermark) {
        let Some(settled) = self.settled.get_mut(worker as usize) else {
            self.violations.add(format!("I1: a checkpoint contains unknown worker {worker}"));
            return;
        };
        if mark > *settled {
            self.violations.add(format!(
                "I1: a learner resumes at {mark:?} of worker {worker}, but {settled:?} was \
                 inserted last"
            ));
        }
        *settled = mark.min(*settled);
        for (incarnation, state) in &mut self.incarnations[worker as usize] {
            if *incarnation >= mark.incarnation {
                let kept = if *incarnation == mark.incarnation { mark.sequence } else { 0 };
                state.roll_back_to(kept);
            }
        }
    }

    fn on_started(&mut self, deaths: u64, counters: LearnerCounters) {
        let lineage: u64 = self.all_incarnations().map(IncarnationState::inserted).sum();
        if lineage != counters.segments {
            self.violations.add(format!(
                "I5: the learner after {deaths} deaths counts {} segments, its marks {lineage}",
                counters.segments
            ));
        }
        // The newest checkpoint may be incomplete on disk, but the previous one must be complete.
        match self.checkpoint_counters.iter().rposition(|earlier| *earlier == counters) {
            Some(index) if index + 2 >= self.checkpoint_counters.len() => {
                self.checkpoint_counters.truncate(index + 1);
            }
            Some(index) => {
                self.violations.add(format!(
                    "I5: the learner after {deaths} deaths went back {} checkpoints, to \
                     {counters:?}",
                    self.checkpoint_counters.len() - 1 - index
                ));
                self.checkpoint_counters.truncate(index + 1);
            }
            None => {
                self.violations.add(format!(
                    "I5: the learner after {deaths} deaths starts with {counters:?}, which no \
                     checkpoint has"
                ));
                self.checkpoint_counters.push(counters);
            }
        }
        self.counters = counters;
        self.steps_since_checkpoint = None;
    }

    fn on_inserted(&mut self, segment: &SegmentDigest) {
        let Some(mark) = self.check_arrival(segment, "inserted") else { return };
        let state = self.incarnations[segment.worker as usize].entry(mark.incarnation).or_default();
        state.settle(mark.sequence);
        self.settled[segment.worker as usize] = mark;
        self.counters.segments += 1;
        self.counters.env_steps += segment.env_steps;
        let Some(steps) = &mut self.steps_since_checkpoint else { return };
        let before = *steps;
        *steps += segment.env_steps;
        let limit = INTERVALS_MAX * self.checkpoint_interval + SEGMENT_STEPS;
        if before <= limit && *steps > limit {
            self.violations.add(format!("I5: no checkpoint was begun within {limit} steps"));
        }
    }

    fn on_rejected(&mut self, segment: &SegmentDigest) {
        let Some(mark) = self.check_arrival(segment, "rejected") else { return };
        let state = self.incarnations[segment.worker as usize].entry(mark.incarnation).or_default();
        state.settle(mark.sequence);
        state.rejected.insert(mark.sequence);
        self.settled[segment.worker as usize] = mark;
    }

    /// Checks a segment that a learner settles, and returns its mark. Returns `None` if it does not
    /// come after the worker's last segment.
    fn check_arrival(&mut self, segment: &SegmentDigest, what: &str) -> Option<Watermark> {
        let SegmentDigest { worker, mark, checksum, .. } = *segment;
        let name = format!(
            "segment {} of worker {worker}, incarnation {}, was {what}",
            mark.sequence, mark.incarnation
        );
        let Some(last) = self.settled.get(worker as usize).copied() else {
            self.violations.add(format!("I9: {name}, but the worker is unknown"));
            return None;
        };
        let state = self.incarnations[worker as usize].get(&mark.incarnation);
        let index = usize::try_from(mark.sequence).unwrap_or(usize::MAX).wrapping_sub(1);
        match state.and_then(|state| state.produced.get(index)) {
            None => self.violations.add(format!("I9: {name}, but was never produced")),
            Some(produced) if *produced != checksum => self.violations.add(format!(
                "I4: {name} with checksum {checksum:#010x}, produced with {produced:#010x}"
            )),
            Some(_) => {}
        }
        if mark > last {
            return Some(mark);
        }
        if state.is_some_and(|state| state.has_settled(mark.sequence)) {
            self.violations.add(format!("I2: {name} twice"));
        } else {
            self.violations.add(format!("I3: {name} after {last:?}"));
        }
        None
    }

    fn all_incarnations(&self) -> impl Iterator<Item = &IncarnationState> {
        self.incarnations.iter().flat_map(BTreeMap::values)
    }

    /// Checks the final state after all journals have been read.
    pub(super) fn conclude(&mut self) -> SegmentTotals {
        let mut totals = SegmentTotals { duplicate: self.duplicate, ..SegmentTotals::default() };
        for (worker, incarnations) in self.incarnations.iter().enumerate() {
            for (incarnation, state) in incarnations {
                let lost = state.lost();
                totals.produced += state.produced.len() as u64;
                totals.inserted += state.inserted();
                totals.rejected += state.rejected.len() as u64;
                totals.in_flight += state.in_flight();
                totals.acknowledged += state.acked;
                totals.lost += lost;
                if lost > 0 {
                    self.violations.add(format!(
                        "I1: {lost} segments of worker {worker}, incarnation {incarnation}, are \
                         lost: {} acknowledged, {} inserted",
                        state.acked,
                        state.inserted()
                    ));
                }
            }
        }
        let SegmentTotals { produced, inserted, rejected, in_flight, lost, .. } = totals;
        if produced != inserted + rejected + in_flight + lost {
            self.violations.add(format!(
                "I9: {produced} segments were produced, and {inserted} inserted, {rejected} \
                 rejected, {in_flight} in flight, {lost} lost"
            ));
        }
        totals
    }
}
