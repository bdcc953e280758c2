//! How segments come in: checked, settled and stored, or recovered from the log.

use std::fmt;

use dmprl_shared::segment::{HINDSIGHT, Rejection, Segment, check};
use dmprl_shared::transport::delivery::{LogError, Replayed, SegmentLog};

use super::Learner;

/// Is told of a segment in the moment in which it is inserted or refused, before anybody else can
/// see the difference.
pub type Told = Box<dyn FnMut(&Segment, Result<(), Rejection>)>;

/// Who is told, if anybody: `dmprl chaos` checks what the learner says by it.
#[derive(Default)]
pub struct Witness(pub Option<Told>);

impl fmt::Debug for Witness {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(if self.0.is_some() { "Witness(somebody)" } else { "Witness(nobody)" })
    }
}

impl Learner {
    /// Inserts a segment.
    ///
    /// # Errors
    /// The reason if it does not fit; it is counted and changes nothing else.
    pub fn insert(&mut self, segment: &Segment) -> Result<(), Rejection> {
        let inserted = self.take(segment);
        if let Some(told) = &mut self.witness.0 {
            told(segment, inserted);
        }
        inserted
    }

    fn take(&mut self, segment: &Segment) -> Result<(), Rejection> {
        self.counters.received += 1;
        let sound = check(&segment.header, &segment.block, &self.expected);
        // A header that fits says whose segment it is, so that its worker need not keep a block
        // that nobody will take.
        let is_known = matches!(sound, Ok(()) | Err(Rejection::Checksum | Rejection::Value));
        let settled = if is_known { self.settle(segment) } else { Ok(()) };
        if let Err(why) = sound.and(settled) {
            self.counters.rejected.count(why);
            return Err(why);
        }
        self.store(segment);
        Ok(())
    }

    fn settle(&mut self, segment: &Segment) -> Result<(), Rejection> {
        let lost = self.inbox.settle(&segment.header, &segment.block)?;
        // A worker may claim any number.
        self.counters.lost = self.counters.lost.saturating_add(lost);
        Ok(())
    }

    fn store(&mut self, segment: &Segment) {
        if let Some(normaliser) = &mut self.normaliser {
            let (observations, _, _) = self.expected.layout.split(&segment.block);
            let seen = segment.header.steps_len as usize * normaliser.observation_len();
            normaliser.observe(&observations[..seen]);
        }
        if segment.header.flags & HINDSIGHT != 0 {
            // Experience, and nothing that an environment or an episode did.
            self.replay.insert(&segment.header, &segment.block);
            self.counters.hindsight_segments += 1;
            return;
        }
        self.collector.inserted(segment, self.counters.policy_version);
        self.counters.segments += 1;
        self.counters.env_steps += u64::from(segment.header.steps_len);
        if let Some((ndp, _)) = self.algorithm.on_policy() {
            self.counters.stale_segments += u64::from(!ndp.take(segment));
            return;
        }
        self.replay.insert(&segment.header, &segment.block);
        // While the actor imitates the critic learns from the first step on.
        if !self.is_warming_up() || self.config.demonstrations.are_cloned() {
            self.pacing.inserted();
        }
    }

    fn is_warming_up(&self) -> bool {
        self.counters.env_steps <= self.config.exploration.warm_up_steps
    }

    /// Inserts what a log holds beyond this learner's checkpoint, and logs to it from now on.
    ///
    /// # Errors
    /// If the log cannot be read.
    pub fn recover(&mut self, mut log: SegmentLog) -> Result<Replayed, LogError> {
        let replayed = log.replay(|segment| {
            // Written before the checkpoint, whose writer died before it had emptied the log.
            if !self.inbox.has(&segment.header) {
                // One that is refused now was refused and counted so before.
                let _ = self.insert(segment);
            }
        })?;
        self.counters.log_bytes_cut += replayed.cut_bytes;
        self.inbox.log_to(log);
        Ok(replayed)
    }
}
