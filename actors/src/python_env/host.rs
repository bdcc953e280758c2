//! The Python that runs this program as an extension module.

use std::path::PathBuf;

/// A running Python with the package `dmprl`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HostPython {
    /// The command `dmprl`, a script that runs this program in this Python.
    pub program: PathBuf,
    /// `sys.executable`.
    pub executable: PathBuf,
    /// `sys.prefix`: the virtual environment, or the installation itself.
    pub prefix: PathBuf,
    /// Folder that contains the package `dmprl` and its metadata.
    pub packages: PathBuf,
    /// Whether MuJoCo and Gymnasium are installed.
    pub simulates: bool,
}
