//! Stage 8 of 8, the pictures of a run.

mod learning_curve;

pub use learning_curve::learning_curve;
