//! Stage 8 of 8, the pictures of a run.

mod axes;
mod learning_curve;

pub(crate) use axes::{Axes, Chart};
pub use learning_curve::learning_curve;
