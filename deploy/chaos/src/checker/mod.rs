//! Verifies from the journals that no segment is lost, duplicated or corrupted, and that nothing
//! goes backwards.
//!
//! A learner's *lineage* consists of the segments in its checkpoint, those read from its log, and
//! those it inserted. A starting learner reports, by its checkpoint's marks, how much of its
//! predecessor's lineage is left; the log and the workers supply the rest. The checker stores four
//! bytes per segment, its checksum at the worker. The inserted segments are stored as a number and
//! the gaps below it.

mod life;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use dmprl_shared::transport::delivery::Watermark;
use life::Life;

use super::violations::Violations;
use crate::journal::{Author, Entry, Piece, Record, Standing};

/// Maximum distance between checkpoints, in intervals. A checkpoint being written delays the next,
/// and a segment crosses the limit in one step.
const INTERVALS_MAX: u64 = 2;
/// Upper bound of the environment steps in a segment.
const SEGMENT_STEPS: u64 = 100;

/// Fate of all segments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Sums {
    /// Finished by workers.
    pub(super) produced: u64,
    /// In the last learner's lineage.
    pub(super) inserted: u64,
    /// Rejected permanently, except duplicates.
    pub(super) rejected: u64,
    /// Never sent or never taken, from a worker that was killed or stopped.
    pub(super) in_flight: u64,
    /// Missing although acknowledged, or although later segments of the same worker arrived.
    pub(super) lost: u64,
    /// Rejected as duplicates after a retransmit.
    pub(super) duplicate: u64,
    /// Acknowledged to workers.
    pub(super) acknowledged: u64,
}

/// Follows a run by its journals.
pub(super) struct Checker {
    /// For each worker, its lives by incarnation.
    lives: Vec<BTreeMap<u32, Life>>,
    /// The lineage's last segment of each worker.
    settled: Vec<Watermark>,
    standing: Standing,
    /// Counters at the start and at each checkpoint begun since, without those that a later learner
    /// has rolled back.
    cuts: Vec<Standing>,
    /// Environment steps since the last checkpoint began or the learner started to serve.
    since_cut: u64,
    checkpoint_interval: u64,
    /// Epoch of the newest learner from which each worker has a policy.
    epochs: Vec<u64>,
    duplicate: u64,
    checkpoints: u64,
    pub(super) violations: Violations,
}

impl Checker {
    pub(super) fn new(workers: u32, checkpoint_interval: u64) -> Self {
        let count = workers as usize;
        Self {
            lives: vec![BTreeMap::new(); count],
            settled: vec![Watermark::default(); count],
            standing: Standing::default(),
            cuts: vec![Standing::default()],
            since_cut: 0,
            checkpoint_interval,
            epochs: vec![0; count],
            duplicate: 0,
            checkpoints: 0,
            violations: Violations::default(),
        }
    }

    /// Processes a record. The records of an author must come in order, and a learner's after the
    /// worker records written before them.
    pub(super) fn take(&mut self, author: Author, record: &Record) {
        match (author, record.entry) {
            (Author::Worker(worker, incarnation), entry) => {
                if worker as usize >= self.lives.len() {
                    self.violations.add(format!("I9: a journal of unknown worker {worker}"));
                } else {
                    self.on_worker((worker, incarnation), entry);
                }
            }
            (Author::Learner(_), Entry::Restored(worker, mark)) => self.on_restored(worker, mark),
            (Author::Learner(deaths), Entry::Started(standing)) => {
                self.on_started(deaths, standing);
            }
            (Author::Learner(_), Entry::Serving) => self.since_cut = 0,
            (Author::Learner(_), Entry::Inserted(piece)) => self.on_inserted(&piece),
            (Author::Learner(_), Entry::Refused(_, true)) => self.duplicate += 1,
            (Author::Learner(_), Entry::Refused(piece, false)) => self.on_refused(&piece),
            (Author::Learner(_), Entry::Cut(standing)) => {
                self.cuts.push(standing);
                self.checkpoints += 1;
                self.since_cut = 0;
            }
            (author, entry) => {
                self.violations.add(format!("I9: {author:?} has logged {entry:?}"));
            }
        }
    }

    /// The newest learner's counters.
    pub(super) fn standing(&self) -> Standing {
        self.standing
    }

    /// The newest learner's last segment of each worker.
    pub(super) fn settled(&self) -> &[Watermark] {
        &self.settled
    }

    /// Number of checkpoints begun.
    pub(super) fn checkpoints(&self) -> u64 {
        self.checkpoints
    }

    fn on_worker(&mut self, (worker, incarnation): (u32, u32), entry: Entry) {
        let life = self.lives[worker as usize].entry(incarnation).or_default();
        let name = format!("worker {worker}, incarnation {incarnation}");
        match entry {
            Entry::Produced(piece) => {
                let expected = Watermark { incarnation, sequence: life.produced.len() as u64 + 1 };
                life.produced.push(piece.checksum);
                if (piece.worker, piece.mark) != (worker, expected) {
                    self.violations.add(format!(
                        "I9: {name} has produced segment {} after {}",
                        piece.mark.sequence,
                        expected.sequence - 1
                    ));
                }
            }
            Entry::Acknowledged(mark) => {
                if mark.sequence < life.acked || mark.sequence > life.produced.len() as u64 {
                    self.violations.add(format!(
                        "I1: {name} has had {} acknowledged after {}, and produced {}",
                        mark.sequence,
                        life.acked,
                        life.produced.len()
                    ));
                }
                life.acked = life.acked.max(mark.sequence);
            }
            Entry::Policy { epoch, version } => {
                let newest = &mut self.epochs[worker as usize];
                if epoch < *newest {
                    let text = format!("I6: {name} has gone from epoch {newest} to {epoch}");
                    self.violations.add(text);
                }
                *newest = epoch.max(*newest);
                let (epoch_before, before) = life.policy;
                if epoch == epoch_before && version < before {
                    self.violations.add(format!(
                        "I6: {name} has gone from policy {before} to {version} in epoch {epoch}"
                    ));
                }
                life.policy = (epoch, version);
            }
            entry => self.violations.add(format!("I9: {name} has logged {entry:?}")),
        }
    }

    /// Rolls the lineage back to a worker's mark in a checkpoint.
    fn on_restored(&mut self, worker: u32, mark: Watermark) {
        let Some(settled) = self.settled.get_mut(worker as usize) else {
            self.violations.add(format!("I1: a checkpoint has unknown worker {worker}"));
            return;
        };
        if mark > *settled {
            self.violations.add(format!(
                "I1: a learner goes on from {mark:?} of worker {worker}, of which {settled:?} was \
                 the last inserted"
            ));
        }
        *settled = mark.min(*settled);
        for (incarnation, life) in &mut self.lives[worker as usize] {
            if *incarnation >= mark.incarnation {
                let kept = if *incarnation == mark.incarnation { mark.sequence } else { 0 };
                life.forget_after(kept);
            }
        }
    }

    fn on_started(&mut self, deaths: u64, standing: Standing) {
        let lineage: u64 = self.all_lives().map(Life::inserted).sum();
        if lineage != standing.segments {
            self.violations.add(format!(
                "I5: the learner after {deaths} deaths counts {} segments, its marks are of \
                 {lineage}",
                standing.segments
            ));
        }
        // The newest checkpoint may have been incomplete on disk; the previous one was complete.
        match self.cuts.iter().rposition(|cut| *cut == standing) {
            Some(index) if index + 2 >= self.cuts.len() => self.cuts.truncate(index + 1),
            Some(index) => {
                self.violations.add(format!(
                    "I5: the learner after {deaths} deaths has gone back {} checkpoints, to \
                     {standing:?}",
                    self.cuts.len() - 1 - index
                ));
                self.cuts.truncate(index + 1);
            }
            None => {
                self.violations.add(format!(
                    "I5: the learner after {deaths} deaths begins with {standing:?}, of which no \
                     checkpoint was made"
                ));
                self.cuts.push(standing);
            }
        }
        self.standing = standing;
        self.since_cut = 0;
    }

    fn on_inserted(&mut self, piece: &Piece) {
        let Some(mark) = self.arrive(piece, "inserted") else { return };
        let life = self.lives[piece.worker as usize].entry(mark.incarnation).or_default();
        life.settle(mark.sequence);
        self.settled[piece.worker as usize] = mark;
        self.standing.segments += 1;
        self.standing.env_steps += piece.env_steps;
        let before = self.since_cut;
        self.since_cut += piece.env_steps;
        let limit = INTERVALS_MAX * self.checkpoint_interval + SEGMENT_STEPS;
        if before <= limit && self.since_cut > limit {
            self.violations.add(format!("I5: no checkpoint was begun in {limit} steps"));
        }
    }

    fn on_refused(&mut self, piece: &Piece) {
        let Some(mark) = self.arrive(piece, "refused") else { return };
        let life = self.lives[piece.worker as usize].entry(mark.incarnation).or_default();
        life.settle(mark.sequence);
        life.refused.insert(mark.sequence);
        self.settled[piece.worker as usize] = mark;
    }

    /// Checks a segment that a learner settles; `None` if it is not the next one.
    fn arrive(&mut self, piece: &Piece, what: &str) -> Option<Watermark> {
        let Piece { worker, mark, checksum, .. } = *piece;
        let name = format!(
            "segment {} of worker {worker}, incarnation {}, was {what}",
            mark.sequence, mark.incarnation
        );
        let Some(last) = self.settled.get(worker as usize).copied() else {
            self.violations.add(format!("I9: {name}, but there is no such worker"));
            return None;
        };
        let life = self.lives[worker as usize].get(&mark.incarnation);
        let index = usize::try_from(mark.sequence).unwrap_or(usize::MAX).wrapping_sub(1);
        match life.and_then(|life| life.produced.get(index)) {
            None => self.violations.add(format!("I9: {name}, but was never produced")),
            Some(produced) if *produced != checksum => self.violations.add(format!(
                "I4: {name} with checksum {checksum:#010x}, produced with {produced:#010x}"
            )),
            Some(_) => {}
        }
        if mark > last {
            return Some(mark);
        }
        if life.is_some_and(|life| life.holds(mark.sequence)) {
            self.violations.add(format!("I2: {name} twice"));
        } else {
            self.violations.add(format!("I3: {name} after {last:?}"));
        }
        None
    }

    fn all_lives(&self) -> impl Iterator<Item = &Life> {
        self.lives.iter().flat_map(BTreeMap::values)
    }

    /// Checks the final state, after all journals have been read.
    pub(super) fn conclude(&mut self) -> Sums {
        let mut sums = Sums { duplicate: self.duplicate, ..Sums::default() };
        for (worker, lives) in self.lives.iter().enumerate() {
            for (incarnation, life) in lives {
                let lost = life.lost();
                sums.produced += life.produced.len() as u64;
                sums.inserted += life.inserted();
                sums.rejected += life.refused.len() as u64;
                sums.in_flight += life.in_flight();
                sums.acknowledged += life.acked;
                sums.lost += lost;
                if lost > 0 {
                    self.violations.add(format!(
                        "I1: {lost} segments of worker {worker}, incarnation {incarnation}, are \
                         lost: {} acknowledged, {} inserted",
                        life.acked,
                        life.inserted()
                    ));
                }
            }
        }
        let Sums { produced, inserted, rejected, in_flight, lost, .. } = sums;
        if produced != inserted + rejected + in_flight + lost {
            self.violations.add(format!(
                "I9: {produced} segments were produced, and {inserted} inserted, {rejected} \
                 rejected, {in_flight} in flight, {lost} lost"
            ));
        }
        sums
    }
}
