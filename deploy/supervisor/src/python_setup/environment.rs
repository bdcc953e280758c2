//! The location of a virtual environment.

use std::path::PathBuf;

use dmprl_actors::python_env::host;

/// A virtual environment in which `import dmprl` works.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PythonEnvironment {
    /// Its directory.
    pub venv: PathBuf,
    /// Its interpreter: `bin/python`, or the Python that runs this program.
    pub executable: PathBuf,
}

impl PythonEnvironment {
    /// Locates the interpreter of a virtual environment.
    #[must_use]
    pub fn of(venv: PathBuf) -> Self {
        let host = host().filter(|host| host.prefix == venv);
        let executable = host.map_or_else(|| venv.join("bin/python"), |it| it.executable.clone());
        Self { venv, executable }
    }
}
