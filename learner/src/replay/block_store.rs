//! The blocks of the replay's segments, in chunks that a checkpoint shares with the running replay.

use std::sync::Arc;

/// Slots of a chunk. A write to a shared chunk copies the whole chunk.
const CHUNK_SLOTS: usize = 1024;

/// The block of every slot. A clone shares all chunks, and a write copies the chunk first.
#[derive(Debug, Clone)]
pub(super) struct BlockStore {
    block_len: usize,
    chunks: Vec<Arc<Vec<f32>>>,
}

impl BlockStore {
    /// Makes zeroed blocks for `slots` slots.
    pub(super) fn new(slots: usize, block_len: usize) -> Self {
        let firsts = (0..slots).step_by(CHUNK_SLOTS);
        let len = |first: usize| (slots - first).min(CHUNK_SLOTS) * block_len;
        // Zeroed pages take no memory until a segment is written to them.
        let chunks = firsts.map(|first| Arc::new(vec![0.0; len(first)])).collect();
        Self { block_len, chunks }
    }

    /// Returns the block of a slot.
    pub(super) fn get(&self, slot: usize) -> &[f32] {
        let at = slot % CHUNK_SLOTS * self.block_len;
        &self.chunks[slot / CHUNK_SLOTS][at..at + self.block_len]
    }

    /// Returns the block of a slot for writing.
    pub(super) fn get_mut(&mut self, slot: usize) -> &mut [f32] {
        let at = slot % CHUNK_SLOTS * self.block_len;
        &mut Arc::make_mut(&mut self.chunks[slot / CHUNK_SLOTS])[at..at + self.block_len]
    }

    /// Returns the blocks of the first `slots` slots, in order, chunk by chunk.
    pub(super) fn first(&self, slots: usize) -> impl Iterator<Item = &[f32]> {
        let chunks = self.chunks.iter().enumerate();
        chunks.map(move |(index, chunk)| &chunk[..slots_in_chunk(index, slots) * self.block_len])
    }

    /// Returns the blocks of the first `slots` slots for writing, in order, chunk by chunk.
    pub(super) fn first_mut(&mut self, slots: usize) -> impl Iterator<Item = &mut [f32]> {
        let (block_len, chunks) = (self.block_len, self.chunks.iter_mut().enumerate());
        chunks.map(move |(index, chunk)| {
            &mut Arc::make_mut(chunk)[..slots_in_chunk(index, slots) * block_len]
        })
    }
}

/// Returns how many of the first `slots` slots are in chunk `index`.
fn slots_in_chunk(index: usize, slots: usize) -> usize {
    slots.saturating_sub(index * CHUNK_SLOTS).min(CHUNK_SLOTS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clone_keeps_what_it_had_and_only_the_piece_that_is_written_is_copied() {
        let slots = 2 * CHUNK_SLOTS + 5;
        let mut blocks = BlockStore::new(slots, 3);
        for slot in 0..slots {
            blocks.get_mut(slot).fill(slot as f32);
        }
        let saved = blocks.clone();
        blocks.get_mut(CHUNK_SLOTS + 1).fill(-1.0);
        assert_eq!(blocks.get(CHUNK_SLOTS + 1), [-1.0; 3]);
        assert!((0..slots).all(|slot| saved.get(slot) == [slot as f32; 3]));
        let shared = |index: usize| Arc::ptr_eq(&blocks.chunks[index], &saved.chunks[index]);
        assert_eq!([0, 1, 2].map(shared), [true, false, true]);
    }

    #[test]
    fn the_first_slots_are_handed_out_in_order() {
        let mut blocks = BlockStore::new(CHUNK_SLOTS + 10, 2);
        let filled = CHUNK_SLOTS + 3;
        let mut count = 0.0;
        for chunk in blocks.first_mut(filled) {
            for value in chunk {
                *value = count;
                count += 1.0;
            }
        }
        let read: Vec<f32> = blocks.first(filled).flatten().copied().collect();
        assert_eq!(read.len(), 2 * filled);
        assert!(read.iter().enumerate().all(|(index, &value)| value == index as f32));
        assert_eq!(blocks.get(filled - 1), [2.0 * filled as f32 - 2.0, 2.0 * filled as f32 - 1.0]);
        assert_eq!(blocks.get(filled), [0.0; 2]);
    }
}
