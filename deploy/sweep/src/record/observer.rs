//! How to start an observer process.

use std::path::PathBuf;

/// Program and Python environment of an observer.
#[derive(Debug, Clone)]
pub struct Observer {
    /// The program that plays the observer: this one.
    pub program: PathBuf,
    /// The Python virtual environment.
    pub venv: PathBuf,
}
