//! Inserts segments: checks them, updates the worker's sequence and stores them. Also recovers them
//! from the log.

use std::fmt;

use dmprl_shared::segment::{HINDSIGHT, Rejection, Segment, check};
use dmprl_shared::transport::delivery::{LogError, Replayed, SegmentLog};

use super::Learner;
use crate::regime::Regime;

/// Called synchronously when a segment is inserted or rejected. `dmprl chaos` checks the learner's
/// counters with it.
#[derive(Default)]
pub struct InsertObserver(Option<Box<InsertCallback>>);

type InsertCallback = dyn FnMut(&Segment, Result<(), Rejection>);

impl InsertObserver {
    /// Makes an observer that calls `callback`.
    #[must_use]
    pub fn new(callback: impl FnMut(&Segment, Result<(), Rejection>) + 'static) -> Self {
        Self(Some(Box::new(callback)))
    }
}

impl fmt::Debug for InsertObserver {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(if self.0.is_some() { "InsertObserver(..)" } else { "InsertObserver" })
    }
}

impl Learner {
    /// Inserts a segment.
    ///
    /// # Errors
    /// The reason if the segment is rejected. A rejection is counted and changes nothing else.
    pub fn insert(&mut self, segment: &Segment) -> Result<(), Rejection> {
        let inserted = self.try_insert(segment);
        if let Some(callback) = &mut self.insert_observer.0 {
            callback(segment, inserted);
        }
        inserted
    }

    fn try_insert(&mut self, segment: &Segment) -> Result<(), Rejection> {
        self.counters.received += 1;
        let checked = check(&segment.header, &segment.block, &self.expected);
        // With a valid header the segment is acknowledged even if its block is damaged, so that the
        // worker does not keep a block that the learner will never accept.
        let has_valid_header =
            matches!(checked, Ok(()) | Err(Rejection::Checksum | Rejection::Value));
        let settled = if has_valid_header { self.settle(segment) } else { Ok(()) };
        if let Err(why) = checked.and(settled) {
            self.counters.rejected.count(why);
            return Err(why);
        }
        self.store(segment);
        Ok(())
    }

    fn settle(&mut self, segment: &Segment) -> Result<(), Rejection> {
        let lost = self.inbox.settle(&segment.header, &segment.block)?;
        // A damaged worker may send any sequence number, so the sum must not overflow.
        self.counters.lost = self.counters.lost.saturating_add(lost);
        Ok(())
    }

    fn store(&mut self, segment: &Segment) {
        if let Some(normaliser) = &mut self.normaliser {
            let (observations, _, _) = self.expected.layout.split(&segment.block);
            let len = segment.header.steps_len as usize * normaliser.observation_len();
            normaliser.observe(&observations[..len]);
            if let Some(goals) = &self.hindsight {
                normaliser.observe_relabelled(&observations[..len], &goals.rule);
            }
        }
        if segment.header.flags & HINDSIGHT != 0 {
            // A hindsight copy is experience, but no step of an environment.
            self.replay.insert(&segment.header, &segment.block);
            self.counters.hindsight_segments += 1;
            return;
        }
        self.collector.inserted(segment, self.counters.policy_version);
        self.counters.segments += 1;
        self.counters.env_steps += u64::from(segment.header.steps_len);
        let is_warming_up = self.counters.env_steps <= self.config.exploration.warm_up_steps;
        match &mut self.regime {
            Regime::OffPolicy(off_policy) => {
                self.replay.insert(&segment.header, &segment.block);
                // While the actor imitates, the critic learns from the first step on.
                if !is_warming_up || off_policy.is_cloning() {
                    off_policy.pacing.inserted();
                }
            }
            Regime::OnPolicy(ndp) => {
                self.counters.stale_segments += u64::from(!ndp.try_insert(segment));
            }
        }
    }

    /// Inserts the logged segments that this learner's checkpoint does not contain, and writes to
    /// the log from now on.
    ///
    /// # Errors
    /// If the log cannot be read.
    pub fn recover(&mut self, mut log: SegmentLog) -> Result<Replayed, LogError> {
        let replayed = log.replay(|segment| {
            // The checkpoint contains a segment if its writer died before it emptied the log.
            if !self.inbox.has(&segment.header) {
                // A rejected segment was rejected and counted in the same way before.
                let _ = self.insert(segment);
            }
        })?;
        self.counters.log_bytes_cut += replayed.cut_bytes;
        self.inbox.log_to(log);
        Ok(replayed)
    }
}
