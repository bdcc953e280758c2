//! Stage 6 of 8: the arithmetic of an update, on buffers made once.
//!
//! The batch is cut into shards of [`SHARD_ROWS`] rows. One thread takes a shard through all
//! forward and backward passes of a step (`thread_pool`, `backward_pass`), so that it stays in that
//! core's cache. Then the threads share the weights, in tiles of some outputs each (`step`): for
//! each tile, one thread sums the gradient over the shards in their order and updates parameters
//! and target network at once. Neither the shards nor the order depend on the number of threads.

pub mod adam;
mod arithmetic;
pub mod backward_pass;
mod bf16_operands;
pub mod kernels;
pub mod layer_norm;
pub mod network;
mod packed_weights;
mod step;
mod sync;
pub mod thread_pool;

/// Rows of the batch in one shard.
pub const SHARD_ROWS: usize = 64;

#[cfg(test)]
#[path = "../../../tests/src/skipped.rs"]
mod skipped;
#[cfg(test)]
mod tests;
