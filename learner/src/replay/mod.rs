//! Stage 5 of 8: stores the experience of off-policy algorithms and samples windows from it.
//!
//! The replay is a ring of slots with one segment each. A slot refers to the slot that continues
//! its episode, so a window of K steps can begin at any step and end in the next slot (`windows =
//! "sliding"`), although the segments of many environments arrive interleaved. When the ring is
//! full, the oldest slot is replaced.

mod block_store;
mod episodes;
mod file;
mod hindsight;
mod jerk;
mod led_to_goal;
mod motion;
mod recent;
mod region;
mod sampler;
mod unreached;
mod window;

use dmprl_shared::segment::{HINDSIGHT, SegmentHeader, SegmentLayout, TERMINATED, TRUNCATED};

use block_store::BlockStore;
use episodes::{Episodes, Place};
pub use file::ReplayFileError;
pub use hindsight::{Goal, GoalSampler, Outcome};
pub use jerk::JerkCost;
pub use sampler::Sampler;
pub use window::Window;

/// Marks the end of a chain of slots.
const NONE: u32 = u32::MAX;

/// A slot without its segment's block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Slot {
    /// The slot that continues this one's episode, or [`NONE`].
    next: u32,
    /// The slot that this one continued when it was inserted, or [`NONE`]. If that slot's segment
    /// has been replaced since, its `next` differs.
    previous: u32,
    /// Steps that were run, 1 to K; 0 in a slot that was never filled.
    steps_len: u8,
    terminated: bool,
    truncated: bool,
    /// Whether this is a hindsight copy, which belongs to no episode.
    hindsight: bool,
    /// Its place in its episode.
    place: Place,
}

/// The newest segment of one environment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Tail {
    slot: u32,
    /// Segments inserted before it; shows whether its slot has been replaced since.
    number: u64,
    incarnation: u32,
    episode: u32,
    /// Steps of the episode until the end of the segment.
    episode_steps: u32,
}

/// The ring. A clone shares the blocks, which are most of its memory, until either side writes.
#[derive(Debug, Clone)]
pub struct Replay {
    layout: SegmentLayout,
    slots: Vec<Slot>,
    blocks: BlockStore,
    episodes: Episodes,
    /// Slot of the next segment.
    head: usize,
    /// Number of filled slots.
    filled: usize,
    /// Number of slots at the front with demonstrations, which are never replaced.
    demonstrations: usize,
    /// Segments ever inserted.
    inserted: u64,
    /// Newest segment of each environment of each worker.
    tails: Vec<Option<Tail>>,
    envs_per_worker: usize,
}

impl Replay {
    /// Makes a replay for `capacity_steps` environment steps from `workers * envs_per_worker`
    /// environments.
    ///
    /// # Panics
    /// If K exceeds 255, which the configuration excludes.
    #[must_use]
    pub fn new(
        layout: SegmentLayout,
        capacity_steps: usize,
        workers: usize,
        envs_per_worker: usize,
    ) -> Self {
        assert!(layout.segment_steps <= 255, "a slot stores its steps in one byte");
        let count = (capacity_steps / layout.segment_steps).max(1);
        Self {
            layout,
            slots: vec![Slot { next: NONE, previous: NONE, ..Slot::default() }; count],
            blocks: BlockStore::new(count, layout.block_len()),
            episodes: Episodes::new(count),
            head: 0,
            filled: 0,
            demonstrations: 0,
            inserted: 0,
            tails: vec![None; workers * envs_per_worker],
            envs_per_worker,
        }
    }

    /// Returns the sizes of a segment.
    #[must_use]
    pub fn layout(&self) -> SegmentLayout {
        self.layout
    }

    /// Returns the number of segments.
    #[must_use]
    pub fn len(&self) -> usize {
        self.filled
    }

    /// Returns whether the replay has no segments.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.filled == 0
    }

    /// Returns the maximum number of segments.
    #[must_use]
    pub fn capacity(&self) -> usize {
        self.slots.len()
    }

    /// Inserts a demonstrated segment, which is never replaced. A segment that does not begin its
    /// episode continues the previous one.
    ///
    /// # Panics
    /// If other segments have been inserted, or no slot would remain for them.
    pub fn insert_demonstration(&mut self, header: &SegmentHeader, block: &[f32]) {
        assert!(
            self.demonstrations == self.filled && self.demonstrations + 1 < self.slots.len(),
            "no room for a demonstration"
        );
        let at = self.store(header, block);
        if header.episode_step > 0 && at > 0 {
            self.chain(at as u32 - 1, at as u32);
        }
        self.demonstrations = at + 1;
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

    /// Writes a segment to the next slot, which is empty or has the oldest segment.
    fn store(&mut self, header: &SegmentHeader, block: &[f32]) -> usize {
        let at = self.head;
        self.blocks.get_mut(at).copy_from_slice(block);
        if at < self.filled {
            self.episodes.release(self.slots[at].place);
        }
        self.slots[at] = Slot {
            next: NONE,
            previous: NONE,
            steps_len: header.steps_len as u8,
            terminated: header.flags & TERMINATED != 0,
            truncated: header.flags & TRUNCATED != 0,
            hindsight: header.flags & HINDSIGHT != 0,
            place: self.episodes.begin(at as u32),
        };
        self.head = if at + 1 == self.slots.len() { self.demonstrations } else { at + 1 };
        self.filled = (self.filled + 1).min(self.slots.len());
        at
    }

    /// Links a segment to its predecessor. A gap in an episode, from a lost segment or a restarted
    /// worker, is never bridged.
    fn link(&mut self, header: &SegmentHeader, slot: u32) {
        let env = header.worker_id as usize * self.envs_per_worker + header.env_index as usize;
        if let Some(tail) = self.tails[env] {
            let continues = tail.incarnation == header.incarnation
                && tail.episode == header.episode
                && tail.episode_steps == header.episode_step
                && self.inserted - tail.number < (self.slots.len() - self.demonstrations) as u64;
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
        self.join_episode(slot, next);
    }

    fn block(&self, slot: usize) -> &[f32] {
        self.blocks.get(slot)
    }
}
