//! The learning algorithms, each in a file to be read beside its paper.

mod batch;
pub mod ddpg;

pub use batch::{Batch, BatchShape, NoWindow};
