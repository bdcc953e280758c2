//! The newest segments of the replay, read from time to time.

use super::Replay;

/// Number of newest segments that are read.
const RECENT_SEGMENTS: usize = 600;
/// Inserted segments between two readings.
const READ_EVERY: u64 = 100;

/// When the newest segments are read next.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Recent {
    /// Number of inserted segments for which a reading is due.
    due: u64,
}

impl Recent {
    /// Returns the newest segments, if a reading is due. They are segments that a replay still has
    /// when the next reading is due, so a resumed run reads the same ones.
    pub(super) fn read(&mut self, replay: &Replay) -> Option<Newest> {
        let inserted = replay.inserted - replay.inserted % READ_EVERY;
        if inserted < self.due {
            return None;
        }
        self.due = inserted + READ_EVERY;
        let later = replay.inserted - inserted;
        let ring = (replay.slots.len() - replay.demonstrations) as u64;
        // Of each environment's episode the start may have been replaced. Its oldest segment is
        // left out, because a replay that is read from a file takes it for the start.
        let kept = ring.saturating_sub(READ_EVERY + replay.tails.len() as u64).min(inserted);
        let mut newest = Newest { slots: Vec::new(), ends: Vec::new(), later, kept };
        newest.slots = newest.all(replay).take(RECENT_SEGMENTS).collect();
        let ends = newest.slots.iter().filter(|&&slot| {
            let segment = &replay.slots[slot as usize];
            segment.terminated || segment.truncated
        });
        newest.ends = ends.copied().collect();
        Some(newest)
    }
}

/// The segments of one reading.
#[derive(Debug)]
pub(super) struct Newest {
    /// Slots of the newest segments, newest first.
    pub(super) slots: Vec<u32>,
    /// Those of them that end an episode.
    pub(super) ends: Vec<u32>,
    /// Segments that were inserted after the first of them, and are not read.
    later: u64,
    /// Number of all segments that may be read.
    kept: u64,
}

impl Newest {
    /// Returns the slots of all segments that may be read, newest first.
    pub(super) fn all(&self, replay: &Replay) -> impl Iterator<Item = u32> {
        (self.later..self.later + self.kept).map_while(|back| replay.slot_before(back))
    }
}

impl Replay {
    /// Returns the slot of the segment that was inserted `back` segments before the newest, of
    /// those that replace each other.
    fn slot_before(&self, back: u64) -> Option<u32> {
        let ring = self.slots.len() - self.demonstrations;
        let position = self.head.checked_sub(self.demonstrations)? + 2 * ring;
        let slot = self.demonstrations + position.checked_sub(1 + back as usize)? % ring;
        (slot < self.filled).then_some(slot as u32)
    }
}
