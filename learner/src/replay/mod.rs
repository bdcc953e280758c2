//! Stage 5 of 8: experience, stored per environment step in the order of each episode.
//!
//! A ring of slots, one slot a segment. A slot knows the slot of the segment that continues its
//! episode, so a window of K steps may begin at any step and run over into the next slot
//! (`windows = "sliding"`), although the segments of many environments arrive interleaved.
//! The oldest slot is replaced when the ring is full.

mod blocks;
mod file;
mod window;

use dmprl_shared::segment::{HINDSIGHT, SegmentHeader, SegmentLayout, TERMINATED, TRUNCATED};

use blocks::Blocks;
pub use file::ReplayFileError;
pub use window::{Sampler, Window};

/// Marks the end of a chain of slots.
const NONE: u32 = u32::MAX;

/// What a slot holds besides its numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Slot {
    /// The slot that continues this one's episode, or [`NONE`].
    next: u32,
    /// The slot that this one continued when it came, or [`NONE`]; its segment may have been
    /// replaced since, and then continues elsewhere or nowhere.
    previous: u32,
    /// Steps really run, 1 to K; 0 in a slot that was never filled.
    steps_len: u8,
    terminated: bool,
    truncated: bool,
    /// A copy with a goal of its own: a sample by itself, and a part of no episode.
    hindsight: bool,
}

/// The newest segment of one environment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Tail {
    slot: u32,
    /// Insertions before it: tells whether its slot has been replaced since.
    number: u64,
    incarnation: u32,
    episode: u32,
    /// Steps of the episode up to the end of the segment.
    episode_steps: u32,
}

/// The ring. A clone shares the numbers, which are most of it, until one of the two writes to them.
#[derive(Debug, Clone)]
pub struct Replay {
    layout: SegmentLayout,
    slots: Vec<Slot>,
    blocks: Blocks,
    /// Where the next segment goes.
    head: usize,
    /// Slots filled.
    filled: usize,
    /// Slots at the front that are never replaced: demonstrations.
    kept: usize,
    /// Segments ever inserted.
    inserted: u64,
    /// Per worker and environment.
    tails: Vec<Option<Tail>>,
    envs_per_worker: usize,
}

impl Replay {
    /// Room for `capacity_steps` environment steps from `workers * envs_per_worker` environments.
    ///
    /// # Panics
    /// If K exceeds 255, which the configuration's check excludes.
    #[must_use]
    pub fn new(
        layout: SegmentLayout,
        capacity_steps: usize,
        workers: usize,
        envs_per_worker: usize,
    ) -> Self {
        assert!(layout.segment_steps <= 255, "a slot counts its steps in a byte");
        let count = (capacity_steps / layout.segment_steps).max(1);
        Self {
            layout,
            slots: vec![Slot { next: NONE, previous: NONE, ..Slot::default() }; count],
            blocks: Blocks::new(count, layout.block_len()),
            head: 0,
            filled: 0,
            kept: 0,
            inserted: 0,
            tails: vec![None; workers * envs_per_worker],
            envs_per_worker,
        }
    }

    /// Sizes of the segments.
    #[must_use]
    pub fn layout(&self) -> SegmentLayout {
        self.layout
    }

    /// Segments held.
    #[must_use]
    pub fn len(&self) -> usize {
        self.filled
    }

    /// Whether nothing is held.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.filled == 0
    }

    /// Segments it has room for.
    #[must_use]
    pub fn capacity(&self) -> usize {
        self.slots.len()
    }

    /// Inserts a demonstrated segment, which is never replaced. One that does not begin its episode
    /// continues the one kept before it.
    ///
    /// # Panics
    /// If anything else has been inserted, or no room were left for more.
    pub fn keep(&mut self, header: &SegmentHeader, block: &[f32]) {
        assert!(self.kept == self.filled && self.kept + 1 < self.slots.len(), "no room to keep it");
        let at = self.store(header, block);
        if header.episode_step > 0 && at > 0 {
            self.chain(at as u32 - 1, at as u32);
        }
        self.kept = at + 1;
        self.inserted += 1;
    }

    /// Inserts a segment that has passed `segment::check`, and links it to its predecessor.
    pub fn insert(&mut self, header: &SegmentHeader, block: &[f32]) {
        let at = self.store(header, block);
        if !self.slots[at].hindsight {
            self.link(header, at as u32);
        }
        self.inserted += 1;
    }

    /// Puts a segment where the oldest is, or nothing yet.
    fn store(&mut self, header: &SegmentHeader, block: &[f32]) -> usize {
        let at = self.head;
        self.blocks.get_mut(at).copy_from_slice(block);
        self.slots[at] = Slot {
            next: NONE,
            previous: NONE,
            steps_len: header.steps_len as u8,
            terminated: header.flags & TERMINATED != 0,
            truncated: header.flags & TRUNCATED != 0,
            hindsight: header.flags & HINDSIGHT != 0,
        };
        self.head = if at + 1 == self.slots.len() { self.kept } else { at + 1 };
        self.filled = (self.filled + 1).min(self.slots.len());
        at
    }

    /// A gap in an episode (a lost segment, a restarted worker) is never bridged.
    fn link(&mut self, header: &SegmentHeader, slot: u32) {
        let env = header.worker_id as usize * self.envs_per_worker + header.env_index as usize;
        if let Some(tail) = self.tails[env] {
            let continues = tail.incarnation == header.incarnation
                && tail.episode == header.episode
                && tail.episode_steps == header.episode_step
                && self.inserted - tail.number < (self.slots.len() - self.kept) as u64;
            if continues {
                self.chain(tail.slot, slot);
            }
        }
        let ended = header.flags & (TERMINATED | TRUNCATED) != 0;
        self.tails[env] = (!ended).then_some(Tail {
            slot,
            number: self.inserted,
            incarnation: header.incarnation,
            episode: header.episode,
            episode_steps: header.episode_step + header.steps_len,
        });
    }

    fn chain(&mut self, slot: u32, next: u32) {
        self.slots[slot as usize].next = next;
        self.slots[next as usize].previous = slot;
    }

    fn block(&self, slot: usize) -> &[f32] {
        self.blocks.get(slot)
    }
}
