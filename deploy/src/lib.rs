//! The dmprl program as a library, for its own tests.

#[cfg(feature = "python")]
pub mod python_setup;
