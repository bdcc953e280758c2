//! The Python that runs this program as an extension module.

use std::path::PathBuf;

use pyo3::prelude::*;

/// A running Python with the package `dmprl`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HostPython {
    /// The command `dmprl`, a script that runs this program in this Python.
    pub program: PathBuf,
    /// `sys.executable`.
    pub executable: PathBuf,
    /// `sys.prefix`: the virtual environment, or the installation itself.
    pub prefix: PathBuf,
    /// Folder that contains the package `dmprl`.
    pub packages: PathBuf,
    /// File with the requirements of the package.
    pub metadata: PathBuf,
}

impl HostPython {
    /// Returns true if everything that an optional part of the package needs is installed.
    #[must_use]
    pub fn has_extra(&self, extra: &str) -> bool {
        let answer = Python::attach(|py| {
            py.import("dmprl_command.installed")?.call_method1("has_extra", (extra,))?.extract()
        });
        answer.unwrap_or_else(|error: PyErr| {
            tracing::warn!("cannot tell whether {extra} is installed: {error}");
            false
        })
    }
}
