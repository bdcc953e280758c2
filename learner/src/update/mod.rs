//! Stage 6 of 8: the kernels of an update, on buffers made once.

pub mod adam;
pub mod backward;
pub mod kernels;
