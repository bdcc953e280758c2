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
    /// Returns the slots of the newest segments, newest first, and of all that may be read, if a
    /// reading is due. A replay still has these when the next reading is due, so a resumed run
    /// reads the same ones.
    pub(super) fn read(&mut self, replay: &Replay) -> Option<(Vec<u32>, Kept)> {
        let inserted = replay.inserted - replay.inserted % READ_EVERY;
        if inserted < self.due {
            return None;
        }
        self.due = inserted + READ_EVERY;
        let newest = replay.inserted - inserted;
        let ring = (replay.slots.len() - replay.demonstrations) as u64;
        // Of each environment's episode the start may have been replaced. Its oldest segment is
        // left out, because a replay that is read from a file takes it for the start.
        let kept = ring.saturating_sub(READ_EVERY + replay.tails.len() as u64);
        let kept = Kept { newest, len: kept.min(inserted) };
        let recent = kept.slots(replay).take(RECENT_SEGMENTS).collect();
        Some((recent, kept))
    }
}

/// Segments of the ring that may be read, as numbers of later segments.
#[derive(Debug, Clone, Copy)]
pub(super) struct Kept {
    newest: u64,
    len: u64,
}

impl Kept {
    /// Returns their slots, newest first.
    pub(super) fn slots(self, replay: &Replay) -> impl Iterator<Item = u32> {
        (self.newest..self.newest + self.len).map_while(|back| replay.slot_before(back))
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
