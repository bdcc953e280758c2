//! Finds the CPython installation that this program uses.

use std::ffi::CStr;
use std::sync::LazyLock;

use pyo3::ffi;

use super::cpython;

/// A CPython installation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LinkedPython {
    /// Its interpreter, outside of any virtual environment; creates `.venv`.
    pub executable: &'static str,
    /// `sys.version` with single spaces: number, build date and compiler.
    pub version: &'static str,
    /// `sys.base_prefix`, which distinguishes installations of one version.
    pub base_prefix: &'static str,
    /// Directory of its libpython; the program's rpath.
    pub library_dir: &'static str,
}

/// The installation that this program was linked against. If it does not exist, because the program
/// was built on another machine, this is the installation whose libpython the process has loaded.
/// For an extension module, it is the one that runs the program.
pub static LINKED_PYTHON: LazyLock<LinkedPython> = LazyLock::new(cpython::installation);

impl LinkedPython {
    /// Version number, for instance `3.11.7`.
    pub fn version_number(&self) -> &'static str {
        self.version.split(' ').next().unwrap_or(self.version)
    }
}

/// Returns `sys.version` of the libpython that this process has loaded, with single spaces as in
/// [`LINKED_PYTHON`]. Works before CPython starts.
#[must_use]
pub fn loaded_python_version() -> String {
    // SAFETY: Py_GetVersion needs no interpreter and returns a static string.
    let version = unsafe { CStr::from_ptr(ffi::Py_GetVersion()) }.to_string_lossy();
    version.split_ascii_whitespace().collect::<Vec<_>>().join(" ")
}
