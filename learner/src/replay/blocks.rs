//! The replay's numbers in pieces, which a checkpoint shares while the ring goes on.

use std::sync::Arc;

/// Slots of a piece: as much is copied when a segment comes into a piece that is being saved.
const PIECE_SLOTS: usize = 1024;

/// The block of every slot. A clone shares all pieces; who then writes to one gets a copy of it.
#[derive(Debug, Clone)]
pub(super) struct Blocks {
    block_len: usize,
    pieces: Vec<Arc<Vec<f32>>>,
}

impl Blocks {
    /// Zeros for `slots` slots.
    pub(super) fn new(slots: usize, block_len: usize) -> Self {
        let firsts = (0..slots).step_by(PIECE_SLOTS);
        let len = |first: usize| (slots - first).min(PIECE_SLOTS) * block_len;
        // Zeroed pages cost nothing until a segment is written to them.
        let pieces = firsts.map(|first| Arc::new(vec![0.0; len(first)])).collect();
        Self { block_len, pieces }
    }

    /// The block of a slot.
    pub(super) fn get(&self, slot: usize) -> &[f32] {
        let at = slot % PIECE_SLOTS * self.block_len;
        &self.pieces[slot / PIECE_SLOTS][at..at + self.block_len]
    }

    /// The same, to be written.
    pub(super) fn get_mut(&mut self, slot: usize) -> &mut [f32] {
        let at = slot % PIECE_SLOTS * self.block_len;
        &mut Arc::make_mut(&mut self.pieces[slot / PIECE_SLOTS])[at..at + self.block_len]
    }

    /// The blocks of the first `slots` slots, in order, a piece at a time.
    pub(super) fn first(&self, slots: usize) -> impl Iterator<Item = &[f32]> {
        let pieces = self.pieces.iter().enumerate();
        pieces.map(move |(index, piece)| &piece[..of_piece(index, slots) * self.block_len])
    }

    /// The same, to be written.
    pub(super) fn first_mut(&mut self, slots: usize) -> impl Iterator<Item = &mut [f32]> {
        let (block_len, pieces) = (self.block_len, self.pieces.iter_mut().enumerate());
        pieces.map(move |(index, piece)| {
            &mut Arc::make_mut(piece)[..of_piece(index, slots) * block_len]
        })
    }
}

/// How many of the first `slots` slots are in a piece.
fn of_piece(index: usize, slots: usize) -> usize {
    slots.saturating_sub(index * PIECE_SLOTS).min(PIECE_SLOTS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clone_keeps_what_it_had_and_only_the_piece_that_is_written_is_copied() {
        let slots = 2 * PIECE_SLOTS + 5;
        let mut blocks = Blocks::new(slots, 3);
        for slot in 0..slots {
            blocks.get_mut(slot).fill(slot as f32);
        }
        let saved = blocks.clone();
        blocks.get_mut(PIECE_SLOTS + 1).fill(-1.0);
        assert_eq!(blocks.get(PIECE_SLOTS + 1), [-1.0; 3]);
        assert!((0..slots).all(|slot| saved.get(slot) == [slot as f32; 3]));
        let shared = |index: usize| Arc::ptr_eq(&blocks.pieces[index], &saved.pieces[index]);
        assert_eq!([0, 1, 2].map(shared), [true, false, true]);
    }

    #[test]
    fn the_first_slots_are_handed_out_in_order() {
        let mut blocks = Blocks::new(PIECE_SLOTS + 10, 2);
        let filled = PIECE_SLOTS + 3;
        let mut count = 0.0;
        for piece in blocks.first_mut(filled) {
            for value in piece {
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
