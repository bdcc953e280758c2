//! Stage 6 of 8: the arithmetic of an update, on buffers made once.
//!
//! The batch is cut into blocks of rows. A block goes through all forward and backward passes of
//! a step on one thread (`crew`, `pass`), its numbers staying in that core's cache; then the
//! gradient of every parameter is summed over the blocks in their order, and Adam and the target
//! follow at once (`trained`), shared out by rows of the weights. Neither the blocks nor the order
//! depend on the number of threads.

pub mod adam;
mod arithmetic;
mod batch_pairs;
pub mod crew;
pub mod floor;
pub mod kernels;
pub mod layer_norm;
mod packed;
pub mod pass;
mod step;
pub mod trained;

/// Rows of a block.
pub const BLOCK_ROWS: usize = 64;

#[cfg(test)]
#[path = "../../../tests/src/skipped.rs"]
mod skipped;
#[cfg(test)]
mod tests;
