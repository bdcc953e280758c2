//! Finds the segments of an episode in the ring, so that hindsight can draw any later step.
//!
//! Every slot knows its episode and its rank in it; the episode knows its newest slot. From there,
//! jump pointers lead to any older rank in O(log n) hops (Myers 1983, "An applicative random-access
//! stack"), although the segments of many episodes arrive interleaved.

use super::{NONE, Replay, Slot};

/// The live segments of an episode.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Episode {
    /// Slot of the newest segment.
    newest: u32,
    /// Rank of the oldest segment that has not been replaced.
    first_rank: u32,
    /// Number of segments that have not been replaced.
    live: u32,
}

/// The place of a slot in its episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Place {
    /// Index of the episode.
    episode: u32,
    /// Segments of the episode before it.
    rank: u32,
    /// An older slot of the episode, or the slot itself.
    jump: u32,
}

/// All episodes of the ring, at most one for each slot.
#[derive(Debug, Clone)]
pub(super) struct Episodes {
    all: Vec<Episode>,
    /// Indices that are not in use.
    free: Vec<u32>,
}

impl Episodes {
    pub(super) fn new(slots: usize) -> Self {
        Self { all: vec![Episode::default(); slots], free: (0..slots as u32).rev().collect() }
    }

    /// Begins an episode with `slot` and returns its place.
    ///
    /// # Panics
    /// If there are more episodes than slots, which cannot be.
    pub(super) fn begin(&mut self, slot: u32) -> Place {
        let episode = self.free.pop().expect("an episode has at least one slot");
        self.all[episode as usize] = Episode { newest: slot, first_rank: 0, live: 1 };
        Place { episode, rank: 0, jump: slot }
    }

    /// Forgets a slot that is about to be replaced. It is the oldest of its episode.
    pub(super) fn release(&mut self, place: Place) {
        let episode = &mut self.all[place.episode as usize];
        episode.live -= 1;
        episode.first_rank = place.rank + 1;
        if episode.live == 0 {
            self.free.push(place.episode);
        }
    }
}

/// Segments of an episode from a slot on, or from the oldest one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Live {
    /// Slot of the newest segment.
    pub(super) newest: u32,
    /// Rank of the oldest segment.
    pub(super) first_rank: u32,
    /// Rank of the newest segment.
    pub(super) last_rank: u32,
}

impl Replay {
    /// Moves a slot that began its own episode to the end of the episode of `previous`.
    pub(super) fn join_episode(&mut self, previous: u32, slot: u32) {
        let own = self.slots[slot as usize].place;
        let before = self.slots[previous as usize].place;
        self.episodes.release(own);
        let rank = |slot: u32| i64::from(self.slots[slot as usize].place.rank);
        let jump = self.slots[before.jump as usize].place.jump;
        let equal = rank(previous) - rank(before.jump) == rank(before.jump) - rank(jump);
        let jump = if equal { jump } else { previous };
        let episode = &mut self.episodes.all[before.episode as usize];
        episode.newest = slot;
        episode.live += 1;
        self.slots[slot as usize].place =
            Place { episode: before.episode, rank: before.rank + 1, jump };
    }

    /// Returns the live segments of the episode of `slot`.
    pub(super) fn live(&self, slot: u32) -> Live {
        let Episode { newest, first_rank, .. } =
            self.episodes.all[self.slots[slot as usize].place.episode as usize];
        Live { newest, first_rank, last_rank: self.slots[newest as usize].place.rank }
    }

    /// Returns the rank of a slot in its episode.
    pub(super) fn rank(&self, slot: u32) -> u32 {
        self.slots[slot as usize].place.rank
    }

    /// Returns the slot with rank `rank` of the episode whose newest slot is `newest`.
    pub(super) fn slot_at(&self, newest: u32, rank: u32) -> Option<u32> {
        let mut slot = newest;
        loop {
            let Slot { place, previous, .. } = self.slots[slot as usize];
            if place.rank <= rank {
                return (place.rank == rank).then_some(slot);
            }
            // A jump may lead to a slot that has been replaced since.
            let target = self.slots[place.jump as usize].place;
            let leads_back = target.episode == place.episode && target.rank < place.rank;
            slot = if leads_back && target.rank >= rank { place.jump } else { previous };
            let next = self.slots.get(slot as usize)?.place;
            if next.episode != place.episode || next.rank >= place.rank {
                return None;
            }
        }
    }

    /// Finds the episodes of all slots from their links, after reading a file.
    pub(super) fn rebuild_episodes(&mut self) {
        self.episodes = Episodes::new(self.slots.len());
        for slot in 0..self.filled as u32 {
            self.slots[slot as usize].place = self.episodes.begin(slot);
        }
        let is_first = |slots: &[Slot], slot: u32| {
            let previous = slots.get(slots[slot as usize].previous as usize);
            previous.is_none_or(|previous| previous.next != slot)
        };
        for first in 0..self.filled as u32 {
            if !is_first(&self.slots, first) {
                continue;
            }
            let mut slot = first;
            loop {
                let next = self.slots[slot as usize].next;
                // In a damaged file two slots may have the same successor.
                if next == NONE || self.slots[next as usize].previous != slot {
                    break;
                }
                self.join_episode(slot, next);
                slot = next;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::segment::{SegmentHeader, SegmentLayout, TRUNCATED};

    use super::*;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 2, observation_len: 1, action_len: 1 };

    /// Inserts segment `index` of an episode of environment `env`; `last` ends it.
    fn insert(replay: &mut Replay, env: u32, index: u32, last: bool) {
        let header = SegmentHeader {
            env_index: env,
            episode_step: 2 * index,
            steps_len: 2,
            flags: if last { TRUNCATED } else { 0 },
            ..SegmentHeader::default()
        };
        replay.insert(&header, &vec![0.0; LAYOUT.block_len()]);
    }

    fn every_rank_is_found(replay: &Replay) {
        for slot in 0..replay.len() as u32 {
            let Live { newest, first_rank, last_rank } = replay.live(slot);
            assert!((first_rank..=last_rank).contains(&replay.rank(slot)));
            assert_eq!(replay.slot_at(newest, replay.rank(slot)), Some(slot));
        }
    }

    #[test]
    fn every_segment_of_interleaved_episodes_is_found_by_its_rank() {
        let mut replay = Replay::new(LAYOUT, 2_000, 1, 3);
        for index in 0..100 {
            for env in 0..3 {
                insert(&mut replay, env, index, index == 99);
            }
        }
        every_rank_is_found(&replay);
        let live = replay.live(1);
        assert_eq!(live, Live { newest: 298, first_rank: 0, last_rank: 99 });
        assert_eq!(replay.slot_at(298, 40), Some(121));
    }

    #[test]
    fn replaced_segments_are_not_found_and_the_rest_is() {
        let mut replay = Replay::new(LAYOUT, 100, 1, 2); // 50 slots
        for episode in 0..7 {
            for index in 0..40 {
                insert(&mut replay, 0, index, index == 39);
                insert(&mut replay, 1, index, index == 39);
                every_rank_is_found(&replay);
            }
            let live = replay.live(replay.tails_slot_before_head());
            assert_eq!((live.first_rank, live.last_rank), (15, 39), "{episode}");
            assert_eq!(replay.slot_at(live.newest, 14), None);
        }
    }

    #[test]
    fn an_episode_longer_than_the_ring_keeps_its_newest_part() {
        let mut replay = Replay::new(LAYOUT, 20, 1, 1); // 10 slots
        for index in 0..57 {
            insert(&mut replay, 0, index, false);
            every_rank_is_found(&replay);
        }
        let live = replay.live(0);
        assert_eq!((live.first_rank, live.last_rank), (47, 56));
    }

    #[test]
    fn a_replay_read_from_a_file_has_the_same_episodes() {
        let mut replay = Replay::new(LAYOUT, 100, 1, 2);
        for index in 0..60 {
            insert(&mut replay, 0, index % 20, index % 20 == 19);
            insert(&mut replay, 1, index % 30, index % 30 == 29);
        }
        let mut bytes = Vec::new();
        replay.write(&mut bytes).unwrap();
        let mut read = Replay::new(LAYOUT, 100, 1, 2);
        read.read(&mut bytes.as_slice()).unwrap();
        every_rank_is_found(&read);
        for slot in 0..50 {
            let (old, new) = (replay.live(slot), read.live(slot));
            assert_eq!(old.newest, new.newest);
            assert_eq!(old.last_rank - old.first_rank, new.last_rank - new.first_rank);
        }
    }

    impl Replay {
        fn tails_slot_before_head(&self) -> u32 {
            (self.head + self.slots.len() - 1) as u32 % self.slots.len() as u32
        }
    }
}
