//! Program and environment of observer processes.

use std::path::PathBuf;

/// Program and Python environment of an observer.
#[derive(Debug, Clone)]
pub struct Observer {
    /// The `dmprl` binary, started as an observer.
    pub program: PathBuf,
    /// The Python virtual environment.
    pub venv: PathBuf,
}
