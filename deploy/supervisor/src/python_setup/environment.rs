//! The location of a virtual environment.

use std::path::PathBuf;

/// A virtual environment in which `import dmprl` works.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PythonEnvironment {
    /// Its directory.
    pub venv: PathBuf,
    /// Its interpreter, `bin/python`.
    pub executable: PathBuf,
}

impl PythonEnvironment {
    pub(super) fn of(venv: PathBuf) -> Self {
        Self { executable: venv.join("bin/python"), venv }
    }
}
