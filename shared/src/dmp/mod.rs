//! Dynamic movement primitives.
